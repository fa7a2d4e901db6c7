"""Parity with LeRobot 0.6.1's groot at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ttscompile.artifact.load import load_artifact
from ttscompile.errors import SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import AS_SAVED, LoadOptions

from . import groots
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import Array
from .whole_vlas import GROOT, Refusals, assert_refused, eager_chunk, refusals, rename_weight

MODEL = GROOT
EMBEDDING = "_groot_model.backbone.model.model.language_model.embed_tokens.weight"


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
    assert_not_read(
        directory,
        "sampler rk4: the actions of this policy are clipped at the end",
        error=SpecError,
        options=LoadOptions(task="go", sampler="rk4"),
    )


def test_either_of_the_tied_embeddings_is_enough(directory: Path, golden: Mapping[str, Array]) -> None:
    rename_weight(directory, "_groot_model.backbone.model.lm_head.weight", EMBEDDING)
    assert np.abs(GROOT.eager(directory, "words", 0) - golden["words.0"]).max() < 1e-4


def test_an_instruction_is_told_as_lerobot_tells_it(directory: Path) -> None:
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    shown = "<|im_start|>user\n" + 2 * "<|vision_start|><|image_pad|><|vision_end|>"
    assert told.line("Push THE block_2!") == f"{shown}push the block_2<|im_end|>\n"
    assert told.line("") == f"{shown}perform the task<|im_end|>\n"
    assert told.line("?!") == f"{shown}Perform the task.<|im_end|>\n"


def test_liberos_rule_makes_the_gripper_one_of_two_numbers(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """Of actions in groups; of shorter ones without LeRobot passes over it."""
    directory = GROOT.save("native", tmp_path / "native", 0)
    groots.with_liberos_rule(directory)
    found = GROOT.eager(directory, "native", 0)
    assert np.abs(found - golden["native.libero"]).max() < 1e-4
    assert found[0, :, -1].tolist() == [1, 1, -1, 1, 1]
    change_json(directory / "config.json", action_decode_transform="auto")  # of another robot than LIBERO's
    assert np.abs(GROOT.eager(directory, "native", 0)[0, :, -1] - [1, 1, -1, 1, 1]).min() > 0.01
    words = GROOT.save("words", tmp_path / "words", 0)
    change_json(words / "config.json", action_decode_transform="libero")
    assert np.abs(GROOT.eager(words, "words", 0) - golden["words.libero"]).max() < 1e-4


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"modality_keys": ["arm", "hand"]}, "no group 'gripper' of actions has one number"),
        ({"action_configs": [{"rep": "ABSOLUTE"}, {"rep": "RELATIVE", "type": "NON_EEF"}]}, "gripper is relative"),
    ],
)
def test_a_gripper_that_liberos_rule_is_not_for(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    directory = GROOT.save("native", tmp_path, 0)
    groots.with_liberos_rule(directory)
    path = directory / "policy_postprocessor.json"
    told = json.loads(path.read_text())
    (step,) = (one["config"] for one in told["steps"] if one["config"].get("raw_stats"))
    raw = step["raw_stats"]
    raw["action"]["hand"], step["use_relative_action"] = raw["action"]["gripper"], "action_configs" in changed
    raw["relative_action"] = {"gripper": raw["action"]["gripper"]}
    step["modality_config"]["action"] |= changed
    path.write_text(json.dumps(told))
    assert_not_read(directory, message)


def test_a_camera_without_a_name_of_its_own_is_shown_alone(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """LeRobot passes over ``observation.image`` where another camera is there."""
    directory = GROOT.save("words", tmp_path, 0)
    config = json.loads((directory / "config.json").read_text())
    one, other = GROOT.cameras
    alone = {**config["input_features"], "observation.image": config["input_features"][one]}
    change_json(directory / "config.json", input_features=alone)
    assert "observation.image" not in load_checkpoint_policy(directory)[1].observations
    assert np.abs(GROOT.eager(directory, "words", 0) - golden["words.0"]).max() < 1e-4
    kept = {key: value for key, value in alone.items() if key not in (one, other)}
    change_json(directory / "config.json", input_features=kept)
    seen = load_checkpoint_policy(directory)[1].observations
    assert [key for key in seen if "image" in key] == ["observation.image"]
    named = {key.replace("observation.image", "camera"): value for key, value in kept.items()}
    change_json(directory / "config.json", input_features=named)
    assert_not_read(directory, "the cameras are camera, of which lerobot shows none; expected observation.images.NAME")


def test_an_embodiment_that_is_in_no_table_has_the_first_ones_weights(directory: Path, tmp_path: Path) -> None:
    """As in LeRobot's training; whoever converts it is told so."""
    path = directory / "policy_preprocessor.json"
    told = json.loads(path.read_text())
    (step,) = (one["config"] for one in told["steps"] if "embodiment_tag" in one["config"])
    step["embodiment_mapping"] = {"somebody": 0, "new_embodiment": 10}
    path.write_text(json.dumps(told))
    known = GROOT.eager(directory, "words", 0)
    step["embodiment_tag"] = "somebody"
    path.write_text(json.dumps(told))
    first = GROOT.eager(directory, "words", 0)
    step["embodiment_tag"] = "mine"
    path.write_text(json.dumps(told))
    np.testing.assert_array_equal(GROOT.eager(directory, "words", 0), first)
    assert np.abs(first - known).max() > 1e-3
    doubts = {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1], None)}
    assert doubts["embodiment"].remedy and "weights of number 0" in doubts["embodiment"].found


def test_a_state_that_is_out_of_range_and_not_clipped(directory: Path, golden: Mapping[str, Array]) -> None:
    given = groots.far(), groots.noise(), GROOT.tokenizer("words"), groots.TASKS[0]
    clipped = eager_chunk(directory, AS_SAVED, *given)[1]
    groots.without_clipping(directory)
    found = eager_chunk(directory, AS_SAVED, *given)[1]
    expected = golden["words.far"]
    assert np.abs(found[:, : expected.shape[1]] - expected).max() < 1e-4
    assert np.abs(found - clipped).max() > 0.01


REFUSED: Refusals = {
    "step/pack": [
        ({"embodiment_tag": None}, "embodiment_tag is None, .*expected the name of an embodiment"),
        ({"embodiment_mapping": {"new_embodiment": "x"}}, "embodiment_mapping .*; expected .* whole numbers by name"),
        ({"embodiment_mapping": {"new_embodiment": 11}}, "weight _groot_model.* has no part 11, of the"),
        ({"max_state_dim": 7}, "max_state_dim is 6; expected 7"),
        ({"state_horizon": 2}, "state_horizon is 2; expected 1"),
        ({"registry_name": "groot_pack_inputs_v3"}, "the step groot_pack_inputs_v3 is of GR00T N1.5"),
    ],
    "step/encode": [
        ({"use_albumentations": True}, "use_albumentations is True; expected false"),
        ({"letter_box_transform": True}, "letter_box_transform is True; expected false"),
        ({"image_target_size": None}, "image_target_size is None; expected height and width of a square"),
        ({"image_target_size": [32, 24]}, "image_target_size is .*; expected height and width of a square"),
        ({"image_target_size": [20, 20]}, "as 20 by 20 pixels .*; expected a multiple of 8 .* 64 to 4096"),
        ({"image_target_size": [72, 72]}, "as 72 by 72 pixels .*resizes them again"),
        ({"crop_fraction": "half"}, "crop_fraction is 'half'; expected a number"),
    ],
    "step/unpack": [
        ({"env_action_dim": 3}, "env_action_dim is 3; expected 5"),
        ({"registry_name": "mine"}, "the step 'mine' is not known here"),
    ],
    "config.json": [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"action_decode_transform": "mine"}, "action_decode_transform is 'mine'; expected libero, none or auto"),
        ({"tokenizer_assets_repo": "lerobot/eagle2hg"}, "this policy is of GR00T N1.5"),
        ({"base_model_path": "nvidia/GR00T-N1.5-3B"}, "this policy is of GR00T N1.5"),
    ],
    "../gr00t-tiny/config.json": [
        ({"input_embedding_dim": 24}, "input_embedding_dim is 24; expected 20"),
        ({"hidden_size": 20}, "hidden_size is 20; expected 18"),
        ({"backbone_embedding_dim": 20}, "backbone_embedding_dim is 20; expected 24"),
        ({"max_seq_len": 4}, "max_seq_len is 4; expected at least the 6 actions"),
        ({"select_layer": 2}, "unexpected backbone.language_model.layers.2"),
    ],
    "../gr00t-tiny/config.json/diffusion_model_cfg": [
        ({"positional_embeddings": "sinusoidal"}, "positional_embeddings is 'sinusoidal'"),
        ({"norm_type": "layer_norm"}, "norm_type is 'layer_norm'; expected ada_norm"),
        ({"interleave_self_attention": False}, "interleave_self_attention is False; expected"),
    ],
    "../gr00t-tiny/config.json/vl_self_attention_cfg": [
        ({"num_attention_heads": 2}, "vl_self_attention_cfg is .*; expected heads of 24")
    ],
    "../Cosmos-Reason2-2B/config.json/vision_config": [
        ({"deepstack_visual_indexes": [0, 3]}, "deepstack_visual_indexes is .*; expected different"),
        ({"deepstack_visual_indexes": [1, 1]}, "expected different layers, from 0 to 2"),
        ({"num_position_embeddings": 24}, "num_position_embeddings is 24; expected a square"),
        ({"num_position_embeddings": 36}, "there are 25 positions of patches; expected 6 by 6"),
        ({"num_heads": 8}, "num_heads is 8; expected heads of a multiple of 4 channels"),
        ({"patch_size": 8}, "patch_size is 4; expected 8"),
        ({"in_channels": 1}, "in_channels is 1; expected 3"),
    ],
    "../Cosmos-Reason2-2B/config.json/text_config": [
        ({"attention_bias": True}, "attention_bias is True; expected false"),
        ({"rope_parameters": {"mrope_section": [8, 8]}}, "mrope_section is .*; expected three whole"),
        ({"rope_parameters": {"rope_type": "yarn"}}, "rope_type is 'yarn'; expected default"),
        ({"num_attention_heads": 3}, "3 heads of 12 channels do not fit 2 of keys"),
    ],
    "../Cosmos-Reason2-2B/config.json": [({"image_token_id": 3}, "makes 0 tokens 3 .* in a prompt of 2 images")],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_steps_in_another_order(directory: Path) -> None:
    """Names of the robot would not be the policy's yet where it is packed; nor are any names after it."""
    path = directory / "policy_preprocessor.json"
    first, *others = json.loads(path.read_text())["steps"]
    assert first["registry_name"] == "rename_observations_processor"
    change_json(path, steps=[*others, first])
    assert_not_read(directory, "expected rename_observations_processor before the other steps")
    change_json(path, steps=[first, *others])
    path = directory / "policy_postprocessor.json"
    change_json(path, steps=[*json.loads(path.read_text())["steps"], first])
    assert_not_read(directory, "the step 'rename_observations_processor' is not known here")


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
    assert_refused(groots.save("native", tmp_path), "step/decode", changes, message)


def test_files_of_the_backbone_that_say_otherwise(directory: Path) -> None:
    folder = directory.parent / groots.BACKBONE
    change_json(folder / "preprocessor_config.json", image_mean=[0.4, 0.4, 0.4])
    assert_not_read(directory, r"image_mean is \[0.4, 0.4, 0.4\]; expected \[0.5, 0.5, 0.5\]")
    change_json(folder / "preprocessor_config.json", image_mean=[0.5, 0.5, 0.5])
    template = folder / "chat_template.jinja"
    template.write_text("{{- 'You are a helpful assistant.' -}}" + template.read_text())
    assert_not_read(directory, "its chat template is another one than is rebuilt here")
    template.unlink()
    load_checkpoint_policy(directory)  # lerobot would not, but nothing here is read from it
