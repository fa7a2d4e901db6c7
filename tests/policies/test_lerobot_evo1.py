"""Parity with LeRobot 0.6.1's evo1 at tiny sizes: from raw images, state and instruction to robot actions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions

from . import evo1s
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import Array
from .whole_vlas import EVO1, Refusals, assert_refused, refusals

MODEL = EVO1
STATISTICS = "policy_preprocessor_step_4_normalizer_processor.safetensors"


def test_a_loop_begins_with_uniform_noise(directory: Path) -> None:
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="go"))
    drawn = spec.draw_initial(np.random.default_rng(0), (50, *spec.sample))
    assert drawn.dtype == np.float32
    assert -1 <= drawn.min() < -0.99 < 0.99 < drawn.max() <= 1
    assert abs(drawn.std() - 3**-0.5) < 0.02


@pytest.mark.parametrize("steps", [4, 32, 37])
def test_times_are_rows_of_the_embedding_as_lerobot_counts_them(directory: Path, steps: int) -> None:
    change_json(directory / "config.json", num_inference_timesteps=steps)
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="go", loops=[("rk4", 2)]))
    assert spec.sampler.timesteps.tolist() == [min(int(k / steps * 999), 999) for k in range(steps)]
    assert (steps < 8) or spec.loops["rk4-2"].timesteps.tolist() == [0, 249, 249, 499, 499, 749, 749, 999]


def test_statistics_of_the_robots_own_width(directory: Path, golden: Mapping[str, Array]) -> None:
    """lerobot pads them when it loads a policy; others than it pads with are not a padding."""
    path = directory / STATISTICS
    whole = load_file(path)
    narrow = {name: value[: 4 if "state" in name else 5].clone() for name, value in whole.items()}
    path.unlink()
    save_file(narrow, path)
    assert np.abs(EVO1.eager(directory, "words", 0) - golden["words.0"]).max() < 1e-4
    whole["observation.state.max"][5] = 2
    path.unlink()
    save_file(whole, path)
    assert_not_read(directory, r"observation.state.max has shape \(7,\); expected \(4,\)")


@pytest.mark.parametrize("values", [(1.0, -1.0), (0.0, 7.0)])
def test_the_gripper_is_one_of_two_numbers(
    directory: Path, golden: Mapping[str, Array], values: tuple[float, float]
) -> None:
    """As lerobot's last step has it, ``torch.where(action > threshold, above, below)``, of what it gave without."""
    given = golden["words.0"]
    limit = float(np.median(given[..., 2])) + 1e-3
    below, above = values
    rule = {"gripper_index": 2, "gripper_threshold": limit}
    rule |= {"gripper_below_threshold_value": below, "gripper_above_threshold_value": above}
    change_json(directory / "config.json", binarize_gripper=True, **rule)
    found = EVO1.eager(directory, "words", 0)
    expected = given.copy()
    expected[..., 2] = np.where(given[..., 2] > limit, above, below)
    assert set(expected[..., 2].ravel()) == set(values)
    assert np.abs(found - expected).max() < 1e-4


REFUSED: Refusals = {
    "config.json": [
        ({"action_head": "diffusion"}, "action_head is 'diffusion'; expected flowmatching"),
        ({"binarize_gripper": True, "gripper_index": 5}, "gripper_index is 5; expected one of the 5 numbers"),
        ({"binarize_gripper": True, "gripper_index": 0, "gripper_threshold": None}, "gripper_threshold is None"),
        ({"image_resolution": [56, 56]}, "image_resolution is .*; expected the language model's image_size, 28"),
        ({"embed_dim": 16}, "embed_dim is 16; expected the language model's width, 24, even, a multiple of 4"),
        ({"num_heads": 5}, "embed_dim is 24; .* a multiple of 5"),
        ({"max_views": 1}, "max_views is 1; expected 2 at least"),
        ({"max_text_length": 40}, "max_text_length is 40; expected more than the .* tokens of 3 images"),
        ({"max_action_dim": 4}, "max_action_dim is 4; expected at least the 5 numbers"),
        ({"postprocess_action_dim": 6}, "postprocess_action_dim is 6; expected null, or 5 at most"),
        ({"num_categories": 2}, "do not fit the configuration: missing action_head.mlp_head.fc1.weight"),
        ({"default_embodiment_id": 1}, "default_embodiment_id is 1; expected a number of the 1 embodiments"),
        ({"num_categories": 2, "embodiment_id_field": "robot"}, "embodiment_id_field is 'robot'; expected null"),
        ({"vlm_num_layers": 1}, "unexpected embedder.language_model.layers.1"),
    ],
    "../internvl-tiny/config.json/vision_config": [
        ({"use_qk_norm": True}, "vision_config.use_qk_norm is True; expected false: another"),
        ({"norm_type": "rms_norm"}, "norm_type is 'rms_norm'; expected layer_norm"),
        ({"patch_size": [7, 14]}, "patch_size is .*; expected a square"),
    ],
    "../internvl-tiny/config.json/text_config": [
        ({"model_type": "qwen3"}, "text_config.model_type is 'qwen3'; expected qwen2"),
        ({"use_sliding_window": True}, "use_sliding_window is True; expected false"),
        ({"max_position_embeddings": 64}, "max_position_embeddings is 64; expected at least .*, 100"),
        ({"rope_parameters": {"rope_type": "yarn"}}, "rope_type is 'yarn'; expected default or dynamic"),
    ],
    "../internvl-tiny/config.json": [
        ({"vision_feature_layer": -2}, "vision_feature_layer is -2; expected -1"),
        ({"downsample_ratio": 0.3}, "downsample_ratio is 0.3; expected one of"),
        ({"image_seq_length": 5}, "image_seq_length is 5; expected 4"),
        ({"image_token_id": 3}, "makes 0 tokens 3 .* in a prompt of 3 images"),
        ({"text_config": None}, "text_config is None; expected its entries"),
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_a_tokenizer_that_is_missing(directory: Path) -> None:
    (directory.parent / evo1s.LANGUAGE / "tokenizer.json").unlink()
    assert_not_read(directory, r"the tokenizer 'internvl-tiny' is not on this machine.*command line\.$")
