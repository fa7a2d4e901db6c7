"""Parity with LeRobot 0.6.1's wall_x at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.nn.functional import interpolate

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.lerobot.resized_bytes import resized

from . import wall_xs
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import STATE, Array
from .whole_vlas import WALL_X, Refusals, assert_refused, refusals

MODEL = WALL_X
EMBEDDING, HEAD = "model.model.embed_tokens.weight", "model.lm_head.weight"
TOKENIZER = wall_xs.SAVED / "flow" / wall_xs.BASE


def change_base(directory: Path, **changes: Any) -> None:
    change_json(directory.parent / wall_xs.BASE / "config.json", **changes)


def change_weights(directory: Path, **changes: torch.Tensor | None) -> None:
    """Save a policy with other weights of these names; None leaves one out."""
    path = directory / "model.safetensors"
    weights = {**load_file(path), **changes}
    path.unlink()  # it is mapped
    save_file({name: value for name, value in weights.items() if value is not None}, path)


@pytest.mark.parametrize(
    "sizes", [((480, 640), (192, 256)), ((192, 256), (196, 252)), ((24, 32), (192, 256)), ((252, 140), (252, 126))]
)
def test_bytes_are_resized_as_on_a_graphics_card(sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """But for what is nearly a half, of which chance decides in float32; the last have many."""
    before, after = sizes
    pixels = torch.from_numpy(np.random.RandomState(0).randint(0, 256, (1, 3, *before)).astype(np.float32))
    floats = interpolate(pixels, after, mode="bicubic", antialias=True, align_corners=False).clamp(0, 255)
    found, clear = resized(before, after, "card")(pixels), ((floats % 1) - 0.5).abs() > 2e-4
    assert clear.float().mean() > 0.998
    np.testing.assert_array_equal(found[clear].numpy(), floats.round()[clear].numpy())
    assert (found - floats).abs().max() < 0.5003
    halves = torch.tensor([10.0, 10.0, 11.0, 11.0]).expand(4, 4)
    assert resized((4, 4), (4, 3), "card")(halves).tolist() == [[10, 11, 11]] * 4


@pytest.mark.slow
@pytest.mark.soak
def test_cameras_of_two_sizes_and_an_expert_of_half_a_token(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(wall_xs.save("nested", tmp_path / "saved"), tmp_path / "compiled", task=wall_xs.TASKS[0])
    policy = ttscompile.load(tmp_path / "compiled")
    given = {key: value[None] for key, value in wall_xs.observation("nested", 0).items()}
    found = policy.predict_action_chunk(given, noise=Noise(wall_xs.noise("nested")))
    assert np.abs(found - golden["nested.0"]).max() < 1e-4
    assert ttscompile.verify(tmp_path / "compiled", calls=1).passed
    kinds = [block.kind for block in load_artifact(tmp_path / "compiled").manifest.blocks]
    assert kinds == ["self_attention", "feed_forward"] * 4


@pytest.mark.slow
def test_attention_that_reads_the_prompt_reads_the_actions_too(compiled: Path) -> None:
    """So its weights are in the artifact once; of the prompt's feed-forward layers nobody needs the last."""
    assert [block.kind for block in load_artifact(compiled).manifest.blocks] == ["self_attention", "feed_forward"] * 3
    weights = load_file(compiled / "weights.safetensors")
    for part, count in (("self_attn.q_proj.weight", 3), ("mlp.gate_proj.weight", 5)):
        names = [name for name in weights if name.endswith(part) and "visual" not in name]
        assert len(names) == count, names


def test_an_instruction_is_a_sentence(directory: Path) -> None:
    """One that is none becomes one; what is around it in its lines is part of the observation."""
    told, tokenizer = load_checkpoint_policy(directory)[1].instruction, Tokenizer(TOKENIZER, CheckpointError)
    assert told is not None
    lines = [told.line(text) for text in ("go", "go.", "go!", "")]
    assert lines == [f"\nInstruction: {each}\n" for each in ("go.", "go.", "go!.", ".")]
    with pytest.raises(CheckpointError, match=r"'to <point>3, 4</point>' holds <point>, no text to this"):
        tokenizer.of_task("to <point>3, 4</point>", told, 80)
    for text in ("see <|image_pad|>", "<|action|>"):
        with pytest.raises(CheckpointError, match=r"holds <\|, no text to this policy"):
            tokenizer.of_task(text, told, 80)
        assert_not_read(directory, r"holds <\|, no text to this policy", options=LoadOptions(task=text))


def test_one_feed_forward_layer_for_all_is_what_equal_experts_do(directory: Path) -> None:
    """``mlp_moe`` false, as in the configuration of a Qwen2.5-VL."""
    path = directory.parent / wall_xs.BASE / "config.json"
    experts, saved = json.loads(path.read_text())["experts"], load_file(directory / "model.safetensors")
    first = {name: value for name, value in saved.items() if ".experts.0." in name}
    second = {name: None for name in saved if ".experts.1." in name}
    change_json(path, experts=[experts[0], experts[0]])
    change_weights(directory, **second | {name.replace("experts.0", "experts.1"): first[name] for name in first})
    expected = WALL_X.eager(directory, "flow", 0)
    change_json(path, mlp_moe=False)
    dense = {name.replace("moe.experts.0", "mlp"): value for name, value in first.items()}
    none = {name: None for name in saved if ".experts." in name}
    change_weights(directory, **none, **dense)
    np.testing.assert_allclose(WALL_X.eager(directory, "flow", 0), expected, rtol=0, atol=1e-6 * np.ptp(expected))


def test_the_statistics_say_how_wide_the_state_is(directory: Path, golden: Mapping[str, Array]) -> None:
    """A policy that was trained from another has that one's width in its configuration."""
    features = json.loads((directory / "config.json").read_text())["input_features"]
    change_json(directory / "config.json", input_features=features | {STATE: {"type": "STATE", "shape": [6]}})
    assert np.abs(WALL_X.eager(directory, "flow", 0) - golden["flow.0"]).max() < WALL_X.close


def test_tied_embeddings_are_one(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    directory = wall_xs.save("nested", tmp_path)
    head = load_file(directory / "model.safetensors")[HEAD]
    change_weights(directory, **{EMBEDDING: head.clone()})
    assert np.abs(WALL_X.eager(directory, "nested", 0) - golden["nested.0"]).max() < WALL_X.close
    change_weights(directory, **{EMBEDDING: head + 1})
    assert_not_read(directory, "lm_head.weight and model.embed_tokens.weight, which differ")
    change_weights(directory, **{EMBEDDING: None})
    change_base(directory, tie_word_embeddings=False)
    assert_not_read(directory, "missing backbone.language_model.embed_tokens.weight")


def test_sizes_of_images_may_have_their_older_names(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    """These are preferred. Without any, images of this size stay as they are."""
    directory = wall_xs.save("nested", tmp_path)
    path = directory.parent / wall_xs.BASE / "processor_config.json"
    own = json.loads(path.read_text())["image_processor"]
    change_json(path, image_processor=own | {"size": None, "min_pixels": 3136, "max_pixels": 40_000})
    assert np.abs(WALL_X.eager(directory, "nested", 0) - golden["nested.0"]).max() < WALL_X.close
    change_json(path, image_processor=own | {"size": None})
    assert np.abs(WALL_X.eager(directory, "nested", 0) - golden["nested.0"]).max() > 0.01


EXPERT = {"hidden_size": 32, "intermediate_size": 44, "hidden_act": "silu"}
REFUSED: Refusals = {
    "config.json": [
        ({"prediction_mode": "fast"}, "prediction_mode is 'fast'; expected diffusion"),
        ({"max_action_dim": 4}, "max_action_dim is 4; expected at least the 5 numbers"),
        ({"max_action_dim": 8}, r"has shape .*; expected .*8, 32\)|expected \(32, 16\)"),
        ({"max_state_dim": 3}, "max_state_dim is 3; expected at least the 4 numbers"),
        ({"max_state_dim": 8}, r"propri_proj.weight has shape \(32, 12\); expected"),
        ({"n_action_steps": 7}, "n_action_steps is 7; expected chunk_size = 6 at most"),
        ({"chunk_size": 500}, "has 8.. tokens, 126 of images and 500 of actions among them; expected 768 at most"),
    ],
    "../wall-oss-tiny/config.json": [
        ({"use_sliding_window": True}, "use_sliding_window is True; expected false"),
        ({"use_lora": True}, "use_lora is True; expected false"),
        ({"head_dim": 16}, "head_dim is 16; expected 8"),
        ({"num_attention_heads": 5}, "hidden_size is 32; expected a multiple of num_attention_heads, 5, and 4"),
        ({"hidden_size": 2, "num_attention_heads": 1}, "hidden_size is 2; expected .* 4 at least"),
        ({"hidden_act": "gelu"}, "hidden_act is 'gelu'; expected silu"),
        ({"num_hidden_layers": 2}, "unexpected .*experts.2."),
        ({"num_experts": 1}, "num_experts is 1; expected 2 at least, of which the second reads actions"),
        ({"num_experts": 3}, "experts is .*; expected the entries of 3"),
        ({"dim_inputs": [16, 32]}, r"dim_inputs is \[16, 32\]; expected 32, all numbers of a token"),
        ({"dim_inputs": [32]}, r"dim_inputs is \[32\]; expected 32, all numbers of a token"),
        ({"dim_inputs": [32, 16]}, "experts.1.hidden_size is 32; expected 16"),
        ({"experts": [EXPERT, EXPERT | {"hidden_act": "gelu"}]}, "experts.1.hidden_act is 'gelu'; expected silu"),
        ({"experts": [EXPERT, EXPERT]}, r"experts.0.down_proj.weight has shape \(32, 20\); expected"),
        ({"mlp_moe": False}, "missing backbone.language_model.layers.0.mlp.|unexpected .*experts"),
        ({"rope_scaling": {"type": "yarn", "mrope_section": [1, 1, 2]}}, "type is 'yarn'; expected default or mrope"),
        ({"rope_scaling": {"mrope_section": [1, 1, 1]}}, "mrope_section is .*; expected three .* 4"),
        ({"image_token_id": 5}, r"expected 259 \(vision_start_token_id\) and 5 \(image_token_id\) of an image"),
        ({"vision_start_token_id": 5}, r"expected 5 \(vision_start_token_id\) and 261 \(image_token_id\)"),
        ({"vision_config": None}, "vision_config is None; expected its entries"),
    ],
    "../wall-oss-tiny/preprocessor_config.json": [
        ({"do_resize": False}, "do_resize is False; expected true"),
        ({"resample": 2}, "resample is 2; expected 3"),
        ({"merge_size": 1}, "merge_size is 1; expected 2"),
        ({"temporal_patch_size": 1}, "temporal_patch_size is 1; expected 2"),
        ({"rescale_factor": 1.0}, "rescale_factor is 1.0; expected 0.0039"),
        ({"image_std": [0.5, 0.5, 0]}, "image_std is .*; expected three numbers from 1e-06 to 1"),
        ({"min_pixels": 0}, "shortest_edge is 0; expected a positive whole number"),
    ],
    "step/wall_x_task": [
        ({"registry_name": "mine"}, "the step 'mine' is not known here"),
        ({"registry_name": "to_batch_processor"}, "has no wall_x_task_processor. Save it again"),
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_named(directory: Path, place: str, changes: dict[str, Any], message: str) -> None:
    assert_refused(directory, place, changes, message)


def test_an_image_that_lerobot_does_not_take_is_named(directory: Path) -> None:
    key = wall_xs.CAMERAS["flow"][1]
    features = json.loads((directory / "config.json").read_text())["input_features"]
    change_json(directory / "config.json", input_features=features | {key: {"type": "VISUAL", "shape": [3, 9, 2000]}})
    assert_not_read(directory, "wrist have 9 x 2000 pixels, of which lerobot makes 1 x 256; exp")


def test_a_tokenizer_of_another_model_is_named(directory: Path) -> None:
    """One has another name for the state; the other makes a single token of the end of a line and a letter."""
    path = directory.parent / wall_xs.BASE / "tokenizer.json"
    saved = path.read_text()
    path.write_text(saved.replace("<|propri|>", "<|state|>"))
    assert_not_read(directory, "a token each of the state and of an action. It is of another model")
    content = json.loads(saved)
    content["pre_tokenizer"]["use_regex"] = False
    merged = content["model"]["vocab"] | {"\u010aP": content["model"]["vocab"].pop("\u0143")}
    content["model"] |= {"vocab": merged, "merges": [["\u010a", "P"]]}
    path.write_text(json.dumps(content))
    assert_not_read(directory, "makes other tokens of a line where another one is before it")
