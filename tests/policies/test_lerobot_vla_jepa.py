"""Parity with LeRobot 0.6.1's vla_jepa at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise, Switch
from ttscompile.errors import CheckpointError, ObservationError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.passes.split_frames import SplitFrames

from ..families.support import record
from . import originals, vla_jepas
from .lerobot_tiny import change_json
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import (
    assert_a_task_alone_makes_files_of_lerobot,
    assert_agreement_on_random_plans,
    eager_chunk,
    rename_weight,
)

EMBEDDING = "model.qwen.model.model.language_model.embed_tokens.weight"
PATCHES = "model.video_encoder.encoder.embeddings.patch_embeddings.proj.weight"
TOKENIZER = vla_jepas.SAVED / "libero" / vla_jepas.BACKBONE


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_vla_jepa")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return vla_jepas.save("libero", tmp_path)


def eager(directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled."""
    told = directory.parent / vla_jepas.BACKBONE, vla_jepas.TASKS[call]
    return eager_chunk(directory, options, vla_jepas.observation(kind, call), vla_jepas.noise(), *told)[1]


@pytest.mark.parametrize("kind", vla_jepas.KINDS)
@pytest.mark.parametrize("compiled_in", [False, True])
def test_the_rebuilt_network_gives_lerobots_actions(
    tmp_path: Path, kind: str, compiled_in: bool, golden: Mapping[str, Array]
) -> None:
    """Two instructions, states and image sizes; and a camera that the robot lacks."""
    for call in (0, 1):
        directory = vla_jepas.save(kind, tmp_path / str(call), call)
        options = LoadOptions(task=vla_jepas.TASKS[call] if compiled_in else None)
        found = eager(directory, kind, call, options)
        assert found.shape == golden[f"{kind}.{call}"].shape
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < 1e-4
        assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01
    directory = vla_jepas.save(kind, tmp_path / "missing")
    without = LoadOptions(task=vla_jepas.TASKS[0] if compiled_in else None, without_cameras=CAMERAS[:1])
    found = eager(directory, kind, 0, without)
    assert np.abs(found - golden[f"{kind}.missing"]).max() < 1e-4
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.01


@pytest.fixture(scope="module")
def compiled(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("vla_jepa")
    artifact, program = once.compiled(
        "whole vla_jepa", lambda to: ttscompile.convert(vla_jepas.save("libero", folder), to)
    )
    record("LeRobot vla_jepa", "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4", "euler 4", program)
    return artifact


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(compiled: Path, golden: Mapping[str, Array], runtime: str) -> None:
    """The text of the task is an observation, whose tokens the policy makes; pictures have any size."""
    policy = ttscompile.load(compiled, runtime=runtime, tokenizer=TOKENIZER)
    assert set(policy.info.observation) == {STATE, *CAMERAS, TOKENS, MASK}
    for call in (0, 1):
        raw = {key: value[None] for key, value in vla_jepas.observation("libero", call).items()}
        given: dict[str, Any] = {**raw, "task": vla_jepas.TASKS[call]}
        found = policy.predict_action_chunk(given, noise=Noise(vla_jepas.noise()), plan="dense")
        assert found.shape == (1, 3, vla_jepas.ACTION_DIM)
        assert np.abs(found - golden[f"libero.{call}"][:, :3]).max() < 1e-4
    with pytest.raises(ObservationError, match=r"has 121 tokens, and the policy reads 120\. Use fewer words"):
        policy.predict_action_chunk(given | {"task": "x" * 65})
    with pytest.raises(ObservationError, match="takes no prefix: an action holds a number that has two values alone"):
        policy.predict_action(batched(given), prefix=np.zeros((1, 1, vla_jepas.ACTION_DIM), np.float32))


def batched(given: Mapping[str, Any]) -> dict[str, Any]:
    """With an axis of one frame, where there is one."""
    return {key: value if key == "task" else value[:, None] for key, value in given.items()}


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch"])
def test_runtimes_agree_on_random_plans(compiled: Path, runtime: str) -> None:
    assert_agreement_on_random_plans(compiled, runtime)


@pytest.mark.slow
@pytest.mark.soak
def test_in_eight_bits_its_actions_are_near(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(vla_jepas.save("libero", tmp_path / "saved"), tmp_path / "compiled", precision="int8")
    policy = ttscompile.load(tmp_path / "compiled", tokenizer=TOKENIZER)
    assert (policy.info.default_plan, policy.info.precision) == ("full", "int8")
    given = {key: value[None] for key, value in vla_jepas.observation("libero", 0).items()}
    found = policy.predict_action_chunk(given | {"task": vla_jepas.TASKS[0]}, noise=Noise(vla_jepas.noise()))
    apart = np.abs(found - golden["libero.0"][:, :3])
    assert 1e-5 < apart[..., :-1].max() < 0.2
    assert set(np.unique(found[..., -1])) <= {-1, 1}
    assert ttscompile.verify(tmp_path / "compiled", calls=1).passed


@pytest.mark.slow
@pytest.mark.soak
def test_cameras_of_two_sizes_are_compiled(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(vla_jepas.save("plain", tmp_path / "saved"), tmp_path / "compiled")
    tokenizer = vla_jepas.SAVED / "plain" / vla_jepas.BACKBONE
    policy = ttscompile.load(tmp_path / "compiled", tokenizer=tokenizer)
    given = {key: value[None] for key, value in vla_jepas.observation("plain", 0).items()}
    found = policy.predict_action_chunk(given | {"task": vla_jepas.TASKS[0]}, noise=Noise(vla_jepas.noise()))
    assert np.abs(found - golden["plain.0"]).max() < 1e-4


@pytest.mark.slow
def test_pictures_are_encoded_each_by_itself(once: Once, compiled: Path) -> None:
    """At its real size; the tower of this one costs less than looking whether a picture is new."""
    _, program = once.compiled("whole vla_jepa", lambda _: pytest.fail("made above"))
    (tower,) = SplitFrames(1000)(program).program.pieces.towers
    assert [each.shape[1:] for each in tower.inputs.values()] == [(3, 16, 32)]


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    assert ttscompile.verify(compiled, calls=1).passed


@pytest.mark.slow
def test_what_depends_on_words_and_images_alone_leaves_the_loop(compiled: Path) -> None:
    """So do the keys and values that every other layer looks at: of the three last tokens."""
    manifest = load_artifact(compiled).manifest
    blocks = [block.kind for block in manifest.blocks]
    assert blocks == ["cross_attention", "feed_forward", "self_attention", "feed_forward"] * 2
    tokens, width = 1 + 3 + vla_jepas.HORIZON, 16
    looking = 4 * tokens * width * (width + 3)  # queries and outputs; scores and their mean
    assert {block.flops for block in manifest.blocks if block.kind == "cross_attention"} == {looking}


def test_the_gripper_has_two_values(tmp_path: Path) -> None:
    """Half-way between 0 and 1 it is not beyond the threshold, and so has the same value as below it.

    The last number of the second policy's actions has a mean of 0 and a deviation of 1.
    """
    chunk = load_checkpoint_policy(vla_jepas.save("libero", tmp_path / "first"))[1].chunk
    assert chunk.switches == (Switch(6, 0.5, 1.0, -1.0),)
    assert load_checkpoint_policy(vla_jepas.save("libero", tmp_path / "first"))[1].sampler.clip == 1.0
    (alone,) = load_checkpoint_policy(vla_jepas.save("plain", tmp_path / "second"))[1].chunk.switches
    assert (alone.channel, alone.below, alone.above) == (6, 1.0, -1.0)
    assert 0.5 < alone.threshold < 0.5 + 1e-6


@pytest.mark.parametrize(
    ("snap", "decide", "expected"),
    [
        ({}, None, (Switch(6, 0.5, 0.5, 1.0),)),
        ({"gripper_dim": 0, "threshold": 0.25}, None, (Switch(0, 0.25, -0.5, 0.5),)),
        ({"gripper_dim": 0}, {"gripper_dim": 0, "threshold": -1.0}, (Switch(0, 0.5, -1.0, -1.0),)),
        ({"gripper_dim": 7}, {"gripper_dim": 7}, ()),
        (None, None, ()),
    ],
)
def test_the_rule_of_the_gripper_may_be_another(
    directory: Path, snap: dict[str, Any] | None, decide: dict[str, Any] | None, expected: tuple[Switch, ...]
) -> None:
    path = directory / "policy_postprocessor.json"
    steps = {step["registry_name"]: step for step in json.loads(path.read_text())["steps"]}
    for name, own in (("vla_jepa_pre_snap_gripper", snap), ("vla_jepa_binarize_gripper", decide)):
        steps[name]["config"] = own
        if own is None:
            del steps[name]
    change_json(path, steps=list(steps.values()))
    assert load_checkpoint_policy(directory)[1].chunk.switches == expected


def test_either_of_the_tied_embeddings_is_enough(directory: Path, golden: Mapping[str, Array]) -> None:
    rename_weight(directory, "model.qwen.model.lm_head.weight", EMBEDDING)
    assert np.abs(eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4


def test_nothing_of_v_jepa_is_needed_but_the_frames_of_a_step(directory: Path, golden: Mapping[str, Array]) -> None:
    """The prompt asks for one action less than there are steps in a video: four frames are two steps here."""
    path = directory / "model.safetensors"
    weights = {name: value for name, value in load_file(path).items() if not name.startswith("model.video_")}
    path.unlink()
    save_file(weights, path)
    assert np.abs(eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4
    save_file(weights | {PATCHES: torch.zeros(12, 3, 4, 16, 16)}, path)
    assert np.abs(eager(directory, "libero", 0) - golden["libero.0"]).max() > 1e-3


def test_an_instruction_is_told_as_lerobot_tells_it(directory: Path) -> None:
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    shown = "<|im_start|>user\n" + 2 * "<|vision_start|><|image_pad|><|vision_end|>"
    assert told.line(" go!") == f"{shown}Your task is  go!. Infer the temporal dynamics from frames "
    assert told.line("") == f"{shown}Your task is . Infer the temporal dynamics from frames "


def test_lerobots_commands_take_it_with_its_task_alone(directory: Path) -> None:
    assert_a_task_alone_makes_files_of_lerobot(directory)


def test_doctor_knows_statistics_and_tokenizer(directory: Path) -> None:
    found = {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1])}
    assert "263 tokens; 284 are known" in found["tokenizer"].found
    assert "range of 7 numbers" in found["normaliser of action"].found


def test_the_last_step_alone_clips(directory: Path) -> None:
    with pytest.raises(SpecError, match="sampler rk4: the actions of this policy are clipped at the end"):
        load_checkpoint_policy(directory, options=LoadOptions(task="go", sampler="rk4"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"qwen_model_name": "Qwen/Qwen3-VL-2B-Instruct"}, "the backbone 'Qwen/Qwen3-VL-2B-Instruct' is not on this"),
        ({"prompt_template": "Do it."}, "prompt_template is 'Do it.'; expected text with {instruction}"),
        (
            {"prompt_template": "{actions} {instruction} {e_actions}"},
            "expected text with {instruction}, .* in this ord",
        ),
        ({"prompt_template": "{instruction:>9} {e_actions}"}, "expected text with {instruction}"),
        ({"prompt_template": "{instruction}\n{e_actions}"}, "expected text .* in a line from there on"),
        ({"prompt_template": "{instruction"}, "expected text with {instruction}"),
        ({"special_action_token": "<{0}>"}, "special_action_token is '<.0.>'; expected text in which {} stands"),
        (
            {"embodied_action_token": "<|action_0|>"},
            "embodied_action_token is .*; expected a word that .* holds 3 times",
        ),
        ({"action_model_type": "DiT-S"}, "action_model_type is 'DiT-S'; expected DiT-B or DiT-L or DiT-test"),
        ({"action_num_layers": 5}, "missing action_head.model.transformer_blocks.4"),
        ({"num_embodied_action_tokens_per_instruction": 4}, r"future_tokens.weight has shape \(3, 16\); expected"),
        ({"chunk_size": 1100}, r"position_embedding.weight has shape \(1024, 16\)|embed_tokens.weight has shape"),
        ({"resize_images_to": [0, 4]}, "resize_images_to is .*; expected"),
    ],
)
def test_what_is_not_rebuilt_is_named(directory: Path, changes: dict[str, Any], message: str) -> None:
    if "qwen_model_name" in changes:
        (directory.parent / vla_jepas.BACKBONE / "config.json").unlink()
    change_json(directory / "config.json", **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("binarize", {"gripper_dim": 0}, "expected a threshold, and the same gripper_dim in all steps"),
        ("snap", {"threshold": "half"}, "found .*half.*; expected a threshold"),
        ("snap", {"gripper_dim": -1}, "gripper_dim is -1; expected a whole number"),
        ("clip", {"registry_name": "mine"}, "the step 'mine' is not known here"),
        (
            "binarize",
            {"first": True},
            "found vla_jepa_binarize_gripper, .*; expected vla_jepa_clip_actions, vla_jepa_pre",
        ),
    ],
)
def test_steps_that_are_not_rebuilt_are_named(
    directory: Path, name: str, changes: dict[str, Any], message: str
) -> None:
    path = directory / "policy_postprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    (own,) = [step for step in steps if name in step["registry_name"]]
    own["registry_name"] = changes.pop("registry_name", own["registry_name"])
    if changes.pop("first", False):
        steps.insert(0, steps.pop(steps.index(own)))
    own["config"] |= changes
    change_json(path, steps=steps)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_mean": [0.4, 0.4, 0.4]}, r"image_mean is \[0.4, 0.4, 0.4\]; expected \[0.5, 0.5, 0.5\]"),
        ({"do_resize": False}, "do_resize is False; expected true"),
        ({"resample": 2}, "resample is 2; expected 3"),
        ({"size": None}, "size is None; expected its entries"),
    ],
)
def test_images_that_reach_the_backbone_otherwise(directory: Path, changes: dict[str, Any], message: str) -> None:
    path = directory.parent / vla_jepas.BACKBONE / "processor_config.json"
    change_json(path, image_processor=json.loads(path.read_text())["image_processor"] | changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


def test_a_later_lerobot_says_how_images_are_resized(directory: Path, golden: Mapping[str, Array]) -> None:
    """From 0.6.2 on a step before the policy says it, too."""
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    steps.insert(
        3, {"registry_name": "vla_jepa_image_prep", "config": {"resize_to": [20, 28], "expand_channels": True}}
    )
    change_json(path, steps=steps)
    assert np.abs(eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4
    steps[3]["config"]["resize_to"] = [20, 20]
    change_json(path, steps=steps)
    with pytest.raises(CheckpointError, match=r"resize_to is \[20, 20\]; expected \[20, 28\]"):
        load_checkpoint_policy(directory)
