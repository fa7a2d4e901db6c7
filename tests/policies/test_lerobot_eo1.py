"""Parity with LeRobot 0.6.1's eo1 at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.passes.split_frames import SplitFrames
from ttscompile.policies.lerobot.resized_bytes import Filter, resized

from . import eo1s
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import EO1, Refusals, assert_refused, refusals, rename_weight

MODEL = EO1
EMBEDDING = "model.vlm_backbone.model.language_model.embed_tokens.weight"
TOKENIZER = eo1s.SAVED / "plain" / eo1s.BACKBONE


@pytest.mark.parametrize("own", ["pillow", "torchvision"])
@pytest.mark.parametrize(
    "sizes", [((57, 41), (64, 32)), ((40, 64), (80, 32)), ((480, 640), (252, 336)), ((9, 7), (9, 28))]
)
def test_bytes_are_resized_as_the_originals_do_it(own: Filter, sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """To the bit: half the size has ties, and 480 x 640 many weights.

    Pillow 13, which lerobot does not take yet, begins with the columns only where these are the smaller part.
    """
    before, after = sizes
    pixels = np.random.RandomState(0).randint(0, 256, (3, *before), np.uint8)
    if own == "pillow":
        bicubic = Image.Resampling.BICUBIC
        expected = np.stack([np.asarray(Image.fromarray(each).resize(after[::-1], bicubic)) for each in pixels])
    else:
        settings: dict[str, Any] = {"mode": "bicubic", "antialias": True, "align_corners": False}
        expected = torch.nn.functional.interpolate(torch.from_numpy(pixels)[None], after, **settings)[0].numpy()
    found = resized(before, after, own)(torch.from_numpy(pixels.astype(np.float32)))
    np.testing.assert_array_equal(found.numpy(), expected)


def test_instructions_of_one_batch_may_differ_in_length(tmp_path: Path) -> None:
    """Padding is in the middle of the prompt: what comes after it has the positions that it has without."""
    module, spec = load_checkpoint_policy(eo1s.save("deep", tmp_path))
    given, told = eo1s.observation("deep", 0), [[5, 6, 7, 8, 9], [11]]
    tokens, mask = padded(told, spec.observations[TOKENS].shape[0])
    both: dict[str, Any] = {key: np.stack([value[None]] * 2) for key, value in given.items()} | {
        TOKENS: tokens,
        MASK: mask,
    }
    noise = Noise(np.concatenate([eo1s.noise()] * 2))
    run = eager_policy(module, spec)
    together = run({key: torch.from_numpy(value) for key, value in both.items()}, noise)
    for row in (0, 1):
        own = {key: torch.from_numpy(value[row : row + 1]) for key, value in both.items()}
        alone = run(own, Noise(eo1s.noise()))[0]
        torch.testing.assert_close(together[row], alone, rtol=0, atol=2e-6)
    assert (together[0] - together[1]).abs().max() > 0.01


def test_the_statistics_say_how_wide_the_state_is(directory: Path, golden: Mapping[str, Array]) -> None:
    """A policy that was fine-tuned from a base has the base's width in its configuration."""
    config = json.loads((directory / "config.json").read_text())["input_features"]
    change_json(directory / "config.json", input_features=config | {STATE: {"type": "STATE", "shape": [6]}})
    assert np.abs(EO1.eager(directory, "plain", 0) - golden["plain.0"]).max() < 2e-5


@pytest.mark.slow
@pytest.mark.soak
def test_cameras_of_two_sizes_are_compiled(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(eo1s.save("deep", tmp_path / "saved"), tmp_path / "compiled", task=eo1s.TASKS[0])
    policy = ttscompile.load(tmp_path / "compiled")
    given = {key: value[None] for key, value in eo1s.observation("deep", 0).items()}
    found = policy.predict_action_chunk(given, noise=Noise(eo1s.noise()))
    assert np.abs(found - golden["deep.0"]).max() < 1e-4


@pytest.mark.slow
def test_the_layers_that_read_the_prompt_read_the_actions_too(once: Once, compiled: Path) -> None:
    """So their weights are in the artifact once; and pictures are encoded each by itself, at its real size at least."""
    artifact, (_, program) = load_artifact(compiled), EO1.compiled(once, compiled)
    assert [block.kind for block in artifact.manifest.blocks] == ["self_attention", "feed_forward"] * 3
    weights = load_file(compiled / "weights.safetensors")
    names = [name for name in weights if name.endswith("gate_proj.weight") and "language_model" in name]
    assert len(names) == 3
    towers = SplitFrames(1000)(program).program.pieces.towers
    assert [each.shape[1:] for tower in towers for each in tower.inputs.values()] == [(3, 24, 32), (3, 30, 27)]


def test_either_of_the_tied_embeddings_is_enough(directory: Path, golden: Mapping[str, Array]) -> None:
    rename_weight(directory, "model.vlm_backbone.lm_head.weight", EMBEDDING)
    assert np.abs(EO1.eager(directory, "plain", 0) - golden["plain.0"]).max() < 2e-5


REFUSED: Refusals = {
    "config.json": [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"action_act": "mish"}, "action_act is 'mish'; expected linear or gelu"),
        ({"num_action_layers": 3}, "missing action_out_proj.4"),
        ({"max_action_dim": 4}, "max_action_dim is 4; expected at least the 5 numbers"),
        ({"max_state_dim": 8}, r"state_proj.weight has shape \(24, 7\); expected"),
        ({"chunk_size": 7}, "chunk_size is 6; expected 7"),
        ({"vlm_config": None}, "vlm_config is None; expected its entries"),
    ],
    "config.json/vlm_config/text_config": [
        ({"use_sliding_window": True}, "use_sliding_window is True; expected false"),
        ({"hidden_act": "gelu"}, "hidden_act is 'gelu'; expected silu"),
        ({"num_hidden_layers": 2}, "language_model.layers.2"),
        ({"rope_parameters": {"mrope_section": [2, 2]}}, "mrope_section is .*; expected three whole"),
        ({"rope_parameters": {"mrope_section": [2, 2, 3]}}, "mrope_section is .*; expected three .* 6"),
        (
            {"rope_parameters": {"mrope_section": [2, 2, 2], "rope_type": "yarn"}},
            "rope_type is 'yarn'; expected default or",
        ),
    ],
    "config.json/vlm_config/vision_config": [
        ({"fullatt_block_indexes": "1"}, "fullatt_block_indexes is '1'; expected numbers of layers, from 0 to 2"),
        ({"window_size": 4}, "window_size 4; expected .* windows of a token at least"),
        ({"num_heads": 3}, "num_heads 3 .*expected heads of a multiple of 4"),
        ({"in_channels": 1}, "in_channels is 1; expected 3"),
    ],
    "../Qwen2.5-VL-tiny/processor_config.json/image_processor": [
        ({"image_mean": [0.5, 0.5, 0.5]}, r"image_mean is \[0.5, 0.5, 0.5\]; expected \[0.48145466"),
        ({"do_resize": False}, "do_resize is False; expected true"),
        ({"merge_size": 1}, "merge_size is 1; expected 2"),
    ],
    "step/eo1_qwen": [
        ({"image_min_pixels": None}, "image_min_pixels is None; expected a positive whole number"),
        ({"registry_name": "mine"}, "the step 'mine' is not known here"),
        ({"registry_name": "to_batch_processor"}, "has no eo1_qwen_processor. Save it again"),
    ],
    "step/eo1_conversation_template": [
        ({"input_features": {}}, r"has the cameras none; expected those of config\.json, observation\.images\.front, "),
        ({"chunk_size": 9}, "chunk_size is 9; expected 6"),
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_images_that_the_processor_does_not_take_are_named(directory: Path) -> None:
    features = json.loads((directory / "config.json").read_text())["input_features"]
    features[CAMERAS[1]]["shape"] = [3, 4, 804]
    change_json(directory / "config.json", input_features=features)
    assert_not_read(directory, "images of 4 x 804 pixels, .*; expected sides of a ratio of 200 at most")


def test_a_chat_template_of_another_model_is_named(directory: Path) -> None:
    (directory.parent / eo1s.BACKBONE / "chat_template.jinja").write_text("{{ messages }}")
    assert_not_read(directory, "its chat template is another one than is rebuilt here; expected Qwen's")


@pytest.mark.parametrize("task", ["<|image_pad|>", "push <|state_pad|>"])
def test_what_is_no_text_to_lerobot_is_refused(directory: Path, task: str) -> None:
    assert_not_read(directory, r"holds <\|, no text to this policy", options=LoadOptions(task=task))
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    with pytest.raises(ObservationError, match="no text to this policy"):
        Tokenizer(TOKENIZER, ObservationError).of_task(task, told, 64)


def test_a_tokenizer_of_another_model_is_named(directory: Path) -> None:
    path = directory / "config.json"
    config = json.loads(path.read_text())["vlm_config"]
    change_json(path, vlm_config=config | {"image_token_id": 5})
    assert_not_read(directory, r"makes 0 tokens 5 \(image_token_id\) of 2 images")


@pytest.mark.slow
def test_a_picture_of_another_size_is_refused(compiled: Path) -> None:
    given = {key: value[None] for key, value in eo1s.observation("plain", 0).items()}
    with pytest.raises(ObservationError, match=r"expected float32 \[B, 3, 24, 32\]; found"):
        ttscompile.load(compiled, tokenizer=TOKENIZER).predict_action_chunk(
            given | {CAMERAS[0]: np.zeros((1, 3, 30, 21), np.float32), "task": "go"}
        )
