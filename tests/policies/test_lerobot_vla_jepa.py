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
from tests.families.scenes import without_scene
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise, Switch
from ttscompile.errors import ObservationError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.passes.split_frames import SplitFrames

from . import vla_jepas
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import Array
from .whole_vlas import VLA_JEPA, Refusals, assert_refused, refusals, rename_weight

MODEL = VLA_JEPA
EMBEDDING = "model.qwen.model.model.language_model.embed_tokens.weight"
PATCHES = "model.video_encoder.encoder.embeddings.patch_embeddings.proj.weight"
TOKENIZER = vla_jepas.SAVED / "libero" / vla_jepas.BACKBONE


@pytest.mark.slow
def test_a_gripper_of_two_values_takes_no_prefix(compiled: Path) -> None:
    given: dict[str, Any] = {key: value[None, None] for key, value in vla_jepas.observation("libero", 0).items()}
    policy = ttscompile.load(compiled, tokenizer=TOKENIZER)
    with pytest.raises(ObservationError, match="takes no prefix: an action holds a number that has two values alone"):
        policy.predict_action(given | {"task": "go"}, prefix=np.zeros((1, 1, vla_jepas.ACTION_DIM), np.float32))


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
    _, program = VLA_JEPA.compiled(once, compiled)
    (tower,) = SplitFrames(1000)(without_scene(program)).program.pieces.towers
    assert [each.shape[1:] for each in tower.inputs.values()] == [(3, 16, 32)]


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
    assert np.abs(VLA_JEPA.eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4


def test_nothing_of_v_jepa_is_needed_but_the_frames_of_a_step(directory: Path, golden: Mapping[str, Array]) -> None:
    """The prompt asks for one action less than there are steps in a video: four frames are two steps here."""
    path = directory / "model.safetensors"
    weights = {name: value for name, value in load_file(path).items() if not name.startswith("model.video_")}
    path.unlink()
    save_file(weights, path)
    assert np.abs(VLA_JEPA.eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4
    save_file(weights | {PATCHES: torch.zeros(12, 3, 4, 16, 16)}, path)
    assert np.abs(VLA_JEPA.eager(directory, "libero", 0) - golden["libero.0"]).max() > 1e-3


def test_an_instruction_is_told_as_lerobot_tells_it(directory: Path) -> None:
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    shown = "<|im_start|>user\n" + 2 * "<|vision_start|><|image_pad|><|vision_end|>"
    assert told.line(" go!") == f"{shown}Your task is  go!. Infer the temporal dynamics from frames "
    assert told.line("") == f"{shown}Your task is . Infer the temporal dynamics from frames "


def test_the_last_step_alone_clips(directory: Path) -> None:
    assert_not_read(
        directory,
        "sampler rk4: the actions of this policy are clipped at the end",
        error=SpecError,
        options=LoadOptions(task="go", sampler="rk4"),
    )


REFUSED: Refusals = {
    "config.json": [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"prompt_template": "Do it."}, "prompt_template is 'Do it.'; expected text with {instruction}"),
        ({"prompt_template": "{actions} {instruction} {e_actions}"}, "expected text with {instruction}, .* in this"),
        ({"prompt_template": "{instruction:>9} {e_actions}"}, "expected text with {instruction}"),
        ({"prompt_template": "{instruction}\n{e_actions}"}, "expected text .* in a line from there on"),
        ({"prompt_template": "{instruction"}, "expected text with {instruction}"),
        ({"special_action_token": "<{0}>"}, "special_action_token is '<.0.>'; expected text in which {} stands"),
        ({"embodied_action_token": "<|action_0|>"}, "embodied_action_token is .*; expected a word .* holds 3 times"),
        ({"action_model_type": "DiT-S"}, "action_model_type is 'DiT-S'; expected DiT-B or DiT-L or DiT-test"),
        ({"action_num_layers": 5}, "missing action_head.model.transformer_blocks.4"),
        ({"num_embodied_action_tokens_per_instruction": 4}, r"future_tokens.weight has shape \(3, 16\); expected"),
        ({"chunk_size": 1100}, r"position_embedding.weight has shape \(1024, 16\)|embed_tokens.weight has shape"),
        ({"resize_images_to": [0, 4]}, "resize_images_to is .*; expected"),
    ],
    "../Qwen3-VL-tiny/processor_config.json/image_processor": [
        ({"image_mean": [0.4, 0.4, 0.4]}, r"image_mean is \[0.4, 0.4, 0.4\]; expected \[0.5, 0.5, 0.5\]"),
        ({"do_resize": False}, "do_resize is False; expected true"),
        ({"resample": 2}, "resample is 2; expected 3"),
        ({"size": None}, "size is None; expected its entries"),
    ],
    "step/binarize": [({"gripper_dim": 0}, "expected a threshold, and the same gripper_dim in all steps")],
    "step/snap": [
        ({"threshold": "half"}, "found .*half.*; expected a threshold"),
        ({"gripper_dim": -1}, "gripper_dim is -1; expected a whole number"),
    ],
    "step/clip": [({"registry_name": "mine"}, "the step 'mine' is not known here")],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_the_gripper_is_decided_last(directory: Path) -> None:
    path = directory / "policy_postprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    (own,) = [step for step in steps if "binarize" in step["registry_name"]]
    steps.remove(own)
    change_json(path, steps=[own, *steps])
    assert_not_read(directory, "found vla_jepa_binarize_gripper, .*; expected vla_jepa_clip_actions, vla_jepa_pre")


def test_a_later_lerobot_says_how_images_are_resized(directory: Path, golden: Mapping[str, Array]) -> None:
    """From 0.6.2 on a step before the policy says it, too."""
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    steps.insert(
        3, {"registry_name": "vla_jepa_image_prep", "config": {"resize_to": [20, 28], "expand_channels": True}}
    )
    change_json(path, steps=steps)
    assert np.abs(VLA_JEPA.eager(directory, "libero", 0) - golden["libero.0"]).max() < 1e-4
    steps[3]["config"]["resize_to"] = [20, 20]
    change_json(path, steps=steps)
    assert_not_read(directory, r"resize_to is \[20, 20\]; expected \[20, 28\]")
