"""Parity with LeRobot 0.6.1's groot at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise
from ttscompile.errors import CheckpointError, ObservationError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import AS_SAVED, LoadOptions

from ..families.support import record
from . import groots, originals
from .lerobot_tiny import change_json
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import (
    assert_a_task_alone_makes_files_of_lerobot,
    assert_agreement_on_random_plans,
    eager_chunk,
    rename_weight,
)

PACK = "policy_preprocessor_step_2_groot_n1_7_pack_inputs_v1.safetensors"
EMBEDDING = "_groot_model.backbone.model.model.language_model.embed_tokens.weight"


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_groot")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return groots.save("words", tmp_path)


def eager(directory: Path, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """What is executed of the rebuilt network's chunk, not compiled."""
    told = directory.parent / groots.BACKBONE, groots.TASKS[call]
    own, actions = eager_chunk(directory, options, groots.observation(call), groots.noise(), *told)
    return actions[:, own.start : own.stop]


@pytest.mark.parametrize("kind", groots.KINDS)
@pytest.mark.parametrize("compiled_in", [False, True])
def test_the_rebuilt_network_gives_lerobots_actions(
    tmp_path: Path, kind: str, compiled_in: bool, golden: Mapping[str, Array]
) -> None:
    """Two instructions, states and image sizes; and a camera that the robot lacks."""
    directory = groots.save(kind, tmp_path)
    for call in (0, 1):
        found = eager(directory, call, LoadOptions(task=groots.TASKS[call] if compiled_in else None))
        assert found.shape == golden[f"{kind}.{call}"].shape
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < 1e-4
        assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01
    without = LoadOptions(task=groots.TASKS[0] if compiled_in else None, without_cameras=CAMERAS[:1])
    found = eager(directory, 0, without)
    assert np.abs(found - golden[f"{kind}.missing"]).max() < 1e-4
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.001


@pytest.fixture(scope="module")
def compiled(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("groot")
    artifact, program = once.compiled("whole groot", lambda to: ttscompile.convert(groots.save("words", folder), to))
    record(
        "LeRobot groot",
        "actions that lerobot 0.6.1 gave, raw observation to action, also relative to state and pose, 1e-4",
        "euler 4",
        program,
    )
    return artifact


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(compiled: Path, golden: Mapping[str, Array], runtime: str) -> None:
    """The text of the task is an observation, whose tokens the policy makes."""
    policy = ttscompile.load(compiled, runtime=runtime, tokenizer=groots.SAVED / "words" / groots.BACKBONE)
    assert set(policy.info.observation) == {STATE, *CAMERAS, TOKENS, MASK}
    for call in (0, 1):
        given = {key: value[None] for key, value in groots.observation(call).items()} | {"task": groots.TASKS[call]}
        found = policy.predict_action_chunk(given, noise=Noise(groots.noise()), plan="dense")
        assert found.shape == (1, 4, 5)
        assert np.abs(found - golden[f"words.{call}"]).max() < 1e-4
    with pytest.raises(ObservationError, match=r"has 74 tokens, and the policy reads 64\. Use fewer words"):
        policy.predict_action_chunk(given | {"task": "x" * 71})


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch"])
def test_runtimes_agree_on_random_plans(compiled: Path, runtime: str) -> None:
    assert_agreement_on_random_plans(compiled, runtime)


@pytest.mark.slow
@pytest.mark.soak
def test_in_eight_bits_its_actions_are_near(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(groots.save("words", tmp_path / "saved"), tmp_path / "compiled", precision="int8")
    policy = ttscompile.load(tmp_path / "compiled", tokenizer=groots.SAVED / "words" / groots.BACKBONE)
    assert (policy.info.default_plan, policy.info.precision) == ("full", "int8")
    given = {key: value[None] for key, value in groots.observation(0).items()} | {"task": groots.TASKS[0]}
    found = policy.predict_action_chunk(given, noise=Noise(groots.noise()))
    assert 1e-5 < np.abs(found - golden["words.0"]).max() < 0.2


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    assert ttscompile.verify(compiled, calls=1).passed


@pytest.mark.slow
def test_what_depends_on_words_and_images_alone_leaves_the_loop(compiled: Path) -> None:
    """So do the keys and values that the head's layers look at: in turn those of 73 words, and of two images."""
    manifest = load_artifact(compiled).manifest
    blocks = [block.kind for block in manifest.blocks]
    assert blocks == ["cross_attention", "feed_forward", "self_attention", "feed_forward"] * 2
    tokens, width = 1 + groots.HORIZON, 20
    looking = [tokens * width * (width + seen) for seen in (73, 2 * 9)]  # queries and outputs; scores and their mean
    assert [block.flops for block in manifest.blocks if block.kind == "cross_attention"] == [4 * n for n in looking]
    assert manifest.spec.source["embodiment"] == "new_embodiment"


def test_the_last_step_alone_clips(directory: Path) -> None:
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="go", loops=[("euler", 2), ("rk4", 1)]))
    table = spec.sampler
    assert (table.clip, table.bound, table.timesteps.tolist()) == (1.0, 1.0, [0, 250, 500, 750])
    assert table.x0_to_next.tolist() == [0, 0, 0, 1]
    assert list(spec.loops) == ["euler-2"]  # a step of rk4 has no sample of its own that could be clipped
    with pytest.raises(SpecError, match="sampler rk4: the actions of this policy are clipped at the end"):
        load_checkpoint_policy(directory, options=LoadOptions(task="go", sampler="rk4"))


def test_either_of_the_tied_embeddings_is_enough(directory: Path, golden: Mapping[str, Array]) -> None:
    rename_weight(directory, "_groot_model.backbone.model.lm_head.weight", EMBEDDING)
    assert np.abs(eager(directory, 0) - golden["words.0"]).max() < 1e-4


def test_an_instruction_is_told_as_lerobot_tells_it(directory: Path) -> None:
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    shown = "<|im_start|>user\n" + 2 * "<|vision_start|><|image_pad|><|vision_end|>"
    assert told.line("Push THE block_2!") == f"{shown}push the block_2<|im_end|>\n"
    assert told.line("") == f"{shown}perform the task<|im_end|>\n"
    assert told.line("?!") == f"{shown}Perform the task.<|im_end|>\n"


def test_lerobots_commands_take_it_with_its_task_alone(directory: Path) -> None:
    assert_a_task_alone_makes_files_of_lerobot(directory)


def test_doctor_knows_statistics_and_tokenizer(directory: Path) -> None:
    found = {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1])}
    assert "263 tokens; 263 are known" in found["tokenizer"].found
    assert "in column 1 of 4, which the policy does not see" in found["normaliser of observation.state"].found
    assert "range of 5 numbers" in found["normaliser of action"].found


def step(directory: Path, name: str, **changes: Any) -> None:
    """Change the configuration of a step, or its name."""
    for path in (directory / f"policy_{each}processor.json" for each in ("pre", "post")):
        pipeline = json.loads(path.read_text())
        for one in pipeline["steps"]:
            if name in one["registry_name"]:
                one["registry_name"] = changes.get("registry_name", one["registry_name"])
                one["config"] |= {key: value for key, value in changes.items() if key != "registry_name"}
        path.write_text(json.dumps(pipeline))


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("pack", {"embodiment_tag": "mine"}, "embodiment_tag 'mine' is none of embodiment_mapping.*Set embodiment_tag"),
        ("pack", {"embodiment_tag": None}, "embodiment_tag None is none of"),
        ("pack", {"embodiment_mapping": {"new_embodiment": 11}}, "weight _groot_model.* has no part 11, of the"),
        ("pack", {"clip_outliers": False}, "clip_outliers is False; expected true"),
        ("pack", {"max_state_dim": 7}, "max_state_dim is 6; expected 7"),
        ("pack", {"state_horizon": 2}, "state_horizon is 2; expected 1"),
        ("pack", {"registry_name": "groot_pack_inputs_v3"}, "the step groot_pack_inputs_v3 is of GR00T N1.5"),
        ("encode", {"use_albumentations": True}, "use_albumentations is True; expected false"),
        ("encode", {"letter_box_transform": True}, "letter_box_transform is True; expected false"),
        ("encode", {"image_target_size": None}, "image_target_size is None; expected height and width of a square"),
        ("encode", {"image_target_size": [32, 24]}, "image_target_size is .*; expected height and width of a square"),
        ("encode", {"image_target_size": [20, 20]}, "as 20 by 20 pixels .*; expected a multiple of 8 .* 64 to 4096"),
        ("encode", {"image_target_size": [72, 72]}, "as 72 by 72 pixels .*resizes them again"),
        ("encode", {"crop_fraction": "half"}, "crop_fraction is 'half'; expected a number"),
        ("unpack", {"env_action_dim": 3}, "env_action_dim is 3; expected 5"),
        ("unpack", {"registry_name": "mine"}, "the step 'mine' is not known here"),
    ],
)
def test_steps_that_are_not_rebuilt_are_named(
    directory: Path, name: str, changes: dict[str, Any], message: str
) -> None:
    step(directory, name, **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


def test_steps_in_another_order(directory: Path) -> None:
    """Names of the robot would not be the policy's yet where it is packed; nor are any names after it."""
    path = directory / "policy_preprocessor.json"
    first, *others = json.loads(path.read_text())["steps"]
    assert first["registry_name"] == "rename_observations_processor"
    change_json(path, steps=[*others, first])
    with pytest.raises(CheckpointError, match="expected rename_observations_processor before the other steps"):
        load_checkpoint_policy(directory)
    change_json(path, steps=[first, *others])
    path = directory / "policy_postprocessor.json"
    change_json(path, steps=[*json.loads(path.read_text())["steps"], first])
    with pytest.raises(CheckpointError, match="the step 'rename_observations_processor' is not known here"):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"use_relative_action": "yes"}, "use_relative_action is 'yes'; expected true or false"),
        ({"raw_stats": {"action": {"arm": {}}}}, "KeyError.*; expected groups of an action .* numbers q01 and q99"),
        ({"modality_config": None}, "TypeError.*; expected groups of an action in modality_config"),
    ],
)
def test_groups_of_actions_that_are_not_rebuilt_are_named(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    directory = groots.save("native", tmp_path)
    step(directory, "decode", **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"action_decode_transform": "libero"}, "action_decode_transform is 'libero'; .* is the robot's to do"),
        ({"action_decode_transform": "auto", "embodiment_tag": "libero_sim"}, "action_decode_transform is 'auto'"),
        ({"tokenizer_assets_repo": "lerobot/eagle2hg"}, "this policy is of GR00T N1.5"),
        ({"base_model_path": "nvidia/GR00T-N1.5-3B"}, "this policy is of GR00T N1.5"),
        ({"base_model_path": "nvidia/GR00T-N1.7-3B"}, "the base model 'nvidia/GR00T-N1.7-3B' is not on this machine"),
    ],
)
def test_what_is_not_rebuilt_is_named(directory: Path, changes: dict[str, Any], message: str) -> None:
    if "base_model_path" in changes:
        (directory.parent / groots.BASE / "config.json").unlink()
    change_json(directory / "config.json", **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        (None, {"input_embedding_dim": 24}, "input_embedding_dim is 24; expected 20"),
        (None, {"hidden_size": 20}, "hidden_size is 20; expected 18"),
        (None, {"backbone_embedding_dim": 20}, "backbone_embedding_dim is 20; expected 24"),
        (None, {"max_seq_len": 4}, "max_seq_len is 4; expected at least the 6 actions"),
        (None, {"model_name": "other/backbone"}, "the backbone 'other/backbone' is not on this machine"),
        (None, {"select_layer": 2}, "unexpected backbone.language_model.layers.2"),
        ("diffusion_model_cfg", {"positional_embeddings": "sinusoidal"}, "positional_embeddings is 'sinusoidal'"),
        ("diffusion_model_cfg", {"norm_type": "layer_norm"}, "norm_type is 'layer_norm'; expected ada_norm"),
        ("diffusion_model_cfg", {"interleave_self_attention": False}, "interleave_self_attention is False; expected"),
        ("vl_self_attention_cfg", {"num_attention_heads": 2}, "vl_self_attention_cfg is .*; expected heads of 24"),
    ],
)
def test_what_is_not_rebuilt_of_the_base_is_named(
    directory: Path, part: str | None, changes: dict[str, Any], message: str
) -> None:
    path = directory.parent / groots.BASE / "config.json"
    change_json(path, **(changes if part is None else {part: json.loads(path.read_text())[part] | changes}))
    if "model_name" in changes:
        (directory.parent / groots.BACKBONE / "config.json").unlink()
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("vision_config", {"deepstack_visual_indexes": [0, 3]}, "deepstack_visual_indexes is .*; expected different"),
        ("vision_config", {"deepstack_visual_indexes": [1, 1]}, "expected different layers, from 0 to 2"),
        ("vision_config", {"num_position_embeddings": 24}, "num_position_embeddings is 24; expected a square"),
        ("vision_config", {"num_position_embeddings": 36}, "there are 25 positions of patches; expected 6 by 6"),
        ("vision_config", {"num_heads": 8}, "num_heads is 8; expected heads of a multiple of 4 channels"),
        ("vision_config", {"patch_size": 8}, "patch_size is 4; expected 8"),
        ("vision_config", {"in_channels": 1}, "in_channels is 1; expected 3"),
        ("text_config", {"attention_bias": True}, "attention_bias is True; expected false"),
        ("text_config", {"rope_parameters": {"mrope_section": [8, 8]}}, "mrope_section is .*; expected three whole"),
        ("text_config", {"rope_parameters": {"rope_type": "yarn"}}, "rope_type is 'yarn'; expected default"),
        ("text_config", {"num_attention_heads": 3}, "3 heads of 12 channels do not fit 2 of keys"),
        (None, {"image_token_id": 3}, "makes 0 tokens 3 .* in a prompt of 2 images"),
    ],
)
def test_what_is_not_rebuilt_of_the_backbone_is_named(
    directory: Path, part: str | None, changes: dict[str, Any], message: str
) -> None:
    path = directory.parent / groots.BACKBONE / "config.json"
    change_json(path, **(changes if part is None else {part: json.loads(path.read_text())[part] | changes}))
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


def test_files_of_the_backbone_that_say_otherwise(directory: Path) -> None:
    folder = directory.parent / groots.BACKBONE
    change_json(folder / "preprocessor_config.json", image_mean=[0.4, 0.4, 0.4])
    with pytest.raises(CheckpointError, match=r"image_mean is \[0.4, 0.4, 0.4\]; expected \[0.5, 0.5, 0.5\]"):
        load_checkpoint_policy(directory)
    change_json(folder / "preprocessor_config.json", image_mean=[0.5, 0.5, 0.5])
    template = folder / "chat_template.jinja"
    template.write_text("{{- 'You are a helpful assistant.' -}}" + template.read_text())
    with pytest.raises(CheckpointError, match="its chat template is another one than is rebuilt here"):
        load_checkpoint_policy(directory)
    template.unlink()
    load_checkpoint_policy(directory)  # lerobot would not, but nothing here is read from it
