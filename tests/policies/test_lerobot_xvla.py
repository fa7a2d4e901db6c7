"""Parity with LeRobot 0.6.1's xvla at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.families.scenes import without_scene
from tests.once import Once
from tests.rounding import assert_equal_but_for_rounding
from tests.samplers.integration import NOISE, by_table, velocity
from ttscompile.errors import TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.passes.split_frames import SplitFrames
from ttscompile.policies.lerobot.files import files_beside
from ttscompile.policies.lerobot.xvla import remixed_table
from ttscompile.policies.networks.internvl import MEAN

from . import xvlas
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import CAMERAS, STATE, Array
from .whole_vlas import XVLA, Refusals, assert_refused, eager_chunk, refusals

MODEL = XVLA
TOKENIZER = xvlas.SAVED / xvlas.LANGUAGE


@pytest.mark.parametrize("mode", xvlas.MODES)
def test_other_action_modes(tmp_path: Path, mode: str, golden: Mapping[str, Array]) -> None:
    found = XVLA.eager(xvlas.save(mode, tmp_path), mode, 0, LoadOptions(task=xvlas.TASKS[0]))
    assert found.shape == golden[mode].shape
    assert np.abs(found - golden[mode]).max() < 1e-5


@pytest.mark.slow
def test_pictures_are_encoded_each_by_itself(once: Once, compiled: Path) -> None:
    """At its real size; the tower of this one costs less than looking whether a picture is new."""
    _, program = XVLA.compiled(once, compiled)
    (tower,) = SplitFrames(1000)(without_scene(program)).program.pieces.towers
    assert [each.shape[1:] for each in tower.inputs.values()] == [(3, 32, 32)]
    assert len(tower.outputs) == 1


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_a_step_mixes_the_prediction_with_the_first_noise(directory: Path, steps: int) -> None:
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="go", steps=steps))
    (name,), (table,) = spec.loops.keys(), spec.loops.values()
    assert (name, spec.sampler.steps, table.memories) == (f"remix-{steps}", 4, 1)
    assert table.timesteps.tolist() == [np.float32(i / steps) for i in range(steps, 0, -1)]
    assert_not_read(
        directory,
        "the loop of xvla is its own. Leave it out",
        error=TtscompileError,
        options=LoadOptions(task="go", sampler="euler"),
    )


def test_what_is_beside_an_image_is_the_mean_colour(directory: Path) -> None:
    """lerobot pads what is normalised with zeros."""
    _, spec = load_checkpoint_policy(directory)
    assert [spec.observations[key].fill for key in CAMERAS] == [(0.485, 0.456, 0.406)] * 2


def test_cameras_of_which_some_are_normalised(directory: Path, golden: Mapping[str, Array]) -> None:
    """By name; or all but observation.image, where no name is given. Beside the others there is black."""
    given = xvlas.observation(1), xvlas.noise("ee6d"), TOKENIZER, xvlas.TASKS[0]
    every = eager_chunk(directory, AS_SAVED, *given)[1]
    xvlas.normalise(directory, [CAMERAS[1]])
    found = eager_chunk(directory, AS_SAVED, *given)[1]
    assert np.abs(found - golden["ee6d.one"]).max() < 1e-5
    assert np.abs(found - every).max() > 1e-3
    assert [load_checkpoint_policy(directory)[1].observations[key].fill for key in CAMERAS] == [(), MEAN]


def test_a_single_cameras_name_beside_others(directory: Path) -> None:
    path, alone = directory / "config.json", "observation.image"
    features = json.loads(path.read_text())["input_features"]
    change_json(path, input_features={alone if key == CAMERAS[0] else key: one for key, one in features.items()})
    _, spec = load_checkpoint_policy(directory)
    assert [spec.observations[key].fill for key in (alone, CAMERAS[1])] == [(), MEAN]


def test_the_robot_is_the_preprocessors(directory: Path, golden: Mapping[str, Array]) -> None:
    """Without its step it is the first."""
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    assert load_checkpoint_policy(directory)[1].source["domain"] == "2"
    change_json(path, steps=[step for step in steps if step["registry_name"] != "xvla_add_domain_id"])
    assert load_checkpoint_policy(directory)[1].source["domain"] == "0"
    assert np.abs(XVLA.eager(directory, "ee6d", 0) - golden["ee6d.0"]).max() > 0.01


def test_weights_as_its_authors_save_them(tmp_path: Path) -> None:
    """Beside LeRobot's JSON files: without the level ``model``, and as Microsoft's code names Florence's layers."""
    directory, options = xvlas.save("auto", tmp_path), LoadOptions(task=xvlas.TASKS[0])
    before, path = load_checkpoint_policy(directory, options=options)[0].state_dict(), directory / "model.safetensors"
    weights = load_file(path)
    assert any(name.startswith("model.vlm.language_model.model.encoder.") for name in weights)
    path.unlink()
    save_file({name.removeprefix("model."): value for name, value in weights.items()}, path)
    found = load_checkpoint_policy(directory, options=options)[0].state_dict()
    assert all(torch.equal(found[name], before[name]) for name in before | found)


def test_a_policy_without_state(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    directory = xvlas.save("agibot_ee6d", tmp_path)
    entries = json.loads((directory / "config.json").read_text())
    entries["input_features"].pop(STATE)
    change_json(directory / "config.json", use_proprio=False, input_features=entries["input_features"])
    weights = load_file(directory / "model.safetensors")
    name = "model.transformer.action_encoder.fc.weight"
    rows = weights[name].view(3, 46, 32)
    weights[name] = torch.cat([rows[:, :20], rows[:, 40:]], 1).flatten(1).contiguous()
    (directory / "model.safetensors").unlink()
    save_file(weights, directory / "model.safetensors")
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="go"))
    assert set(spec.observations) == set(CAMERAS)
    assert np.isfinite(XVLA.eager(directory, "agibot_ee6d", 0, LoadOptions(task=xvlas.TASKS[0]))).all()


def test_lerobots_commands_take_it(directory: Path) -> None:
    files = files_beside(directory, load_checkpoint_policy(directory)[1])
    steps = {step["registry_name"]: step["config"] for step in json.loads(files["policy_preprocessor.json"])["steps"]}
    assert steps["tokenizer_processor"]["max_length"] == 24
    assert not [name for name in steps if name.startswith("xvla")]


REFUSED: Refusals = {
    "config.json": [
        ({"action_mode": "ee7d"}, "action_mode is 'ee7d'; expected one of ee6d, .*, auto"),
        ({"action_mode": "so101_bimanual"}, "max_state_dim is 32; expected 20, with the action_mode so101_bimanual"),
        ({"use_proprio": False}, "use_proprio is False; expected a state of 20 numbers at least .* this action_mode"),
        ({"max_state_dim": 12}, "max_state_dim is 12; expected a state of 20 numbers at least"),
        ({"action_mode": "joint"}, r"action.* has shape \(20,\); expected \(14,\)"),
        ({"domain_feature_key": "robot"}, "domain_feature_key is 'robot'; expected null: .* at every call"),
        ({"num_domains": 2}, "num_domains is 2, and xvla_add_domain_id.domain_id is 2; expected a whole number, 1 at"),
        ({"num_domains": 4}, "do not fit the configuration: missing .*transformer.action_decoder.bias"),
        ({"max_len_seq": 30}, "max_len_seq is 30; expected 49 at least, for 4 views of this size"),
        ({"num_image_views": 50}, "max_len_seq is 96; expected .* at least, for 50 views"),
        ({"depth": 1}, "unexpected transformer.blocks.layers.1"),
        ({"num_heads": 5}, "hidden_size is 32; expected a multiple of num_attention_heads = 5"),
        ({"resize_imgs_with_padding": [1, 320]}, r"images of \[1, 320\] become \[1, 20\] patches; expected 1-6 along"),
        ({"empty_cameras": -1}, "empty_cameras is -1; expected a whole number, 64 at most"),
        ({"florence_config": {}}, "florence_config.vision_config is None; expected its entries"),
    ],
    "config.json/florence_config/vision_config": [
        ({"model_type": "swin"}, "model_type is 'swin'; expected davit or florence_vision"),
        ({"depths": [1, 1]}, r"depths is \[1, 1\]; expected 3 sizes, one for each stage"),
        ({"patch_padding": [1, -1, 1]}, "patch_padding is .*; expected 3 sizes"),
        ({"embed_dim": None}, "embed_dim is None; expected some sizes"),
        ({"projection_dim": 8}, "projection_dim is 8; expected text_config.d_model, 24"),
        ({"in_channels": 4}, "in_channels is 4; expected 3"),
        ({"num_groups": [3, 2, 4]}, "hidden_size is 8; expected a multiple of num_att.* = 3"),
        ({"image_pos_embed": {"type": "sine"}}, "image_pos_embed is .*; expected the type learned"),
        ({"image_feature_source": ["last_frame"]}, "image_feature_source is .*; expected spatial_avg"),
    ],
    "config.json/florence_config/text_config": [
        ({"model_type": "t5"}, "model_type is 't5'; expected florence2_language or bart"),
        ({"activation_function": "relu"}, "activation_function is 'relu'; expected gelu"),
        ({"max_position_embeddings": 20}, "max_position_embeddings: expected 29 at least"),
        ({"pad_token_id": 259}, "pad_token_id is 259; expected a whole number, 258 at most"),
    ],
    "step/tokenizer_processor": [
        ({"padding": "longest"}, "padding is longest, at the right: .* --task on the command"),
        ({"padding_side": "left"}, "padding is max_length, at the left: instructions differ"),
        ({"truncation": False}, "expected such a step, which cuts an instruction"),
    ],
    "step/xvla_add_domain_id": [({"domain_id": -1}, "domain_id is -1; expected a whole number, 2 at most")],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_steps_in_another_order_and_steps_of_a_robot(directory: Path) -> None:
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    change_json(path, steps=[steps[0], *steps[:0:-1]])
    assert_not_read(directory, "xvla_imagenet_normalize is before xvla_image_to_float")
    change_json(path, steps=steps)
    path = directory / "policy_postprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    change_json(path, steps=[*steps, {"registry_name": "xvla_rotation_6d_to_axis_angle", "config": {}}])
    assert_not_read(directory, "'xvla_rotation_6d_to_axis_angle' is not known .* outside of the policy")


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_predicted_actions_are_mixed_with_the_first_noise(steps: int) -> None:
    """As X-VLA does it: what is predicted is not the velocity."""
    table, clean = remixed_table(steps), np.zeros_like(NOISE)
    for i in range(steps, 0, -1):
        clean = velocity(i / steps * NOISE + (1 - i / steps) * clean, i / steps)
    assert (table.name, table.steps, table.memories, table.bound) == ("remix", steps, 1, None)
    assert_equal_but_for_rounding(by_table(table, NOISE, velocity), clean, terms=table.steps)
