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
from ttscompile.errors import CheckpointError, ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.passes.split_frames import SplitFrames
from ttscompile.policies.lerobot.resized_bytes import Filter, resized

from ..families.support import record
from . import eo1s, originals
from .lerobot_tiny import change_json
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import (
    assert_a_task_alone_makes_files_of_lerobot,
    assert_agreement_on_random_plans,
    eager_chunk,
    rename_weight,
)

EMBEDDING = "model.vlm_backbone.model.language_model.embed_tokens.weight"
TOKENIZER = eo1s.SAVED / "plain" / eo1s.BACKBONE


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_eo1")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return eo1s.save("plain", tmp_path)


def eager(directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled."""
    told = directory.parent / eo1s.BACKBONE, eo1s.TASKS[call]
    return eager_chunk(directory, options, eo1s.observation(kind, call), eo1s.noise(), *told)[1]


@pytest.mark.parametrize("kind", eo1s.KINDS)
@pytest.mark.parametrize("compiled_in", [False, True])
def test_the_rebuilt_network_gives_lerobots_actions(
    tmp_path: Path, kind: str, compiled_in: bool, golden: Mapping[str, Array]
) -> None:
    """Two instructions, states and pairs of image sizes; and a policy without one of the cameras."""
    for call in (0, 1):
        directory = eo1s.save(kind, tmp_path / str(call), call)
        options = LoadOptions(task=eo1s.TASKS[call] if compiled_in else None)
        found = eager(directory, kind, call, options)
        assert found.shape == golden[f"{kind}.{call}"].shape
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < 2e-5
        assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01
    directory = eo1s.save(kind, tmp_path / "missing")
    without = LoadOptions(task=eo1s.TASKS[0] if compiled_in else None, without_cameras=CAMERAS[:1])
    found = eager(directory, kind, 0, without)
    assert np.abs(found - golden[f"{kind}.missing"]).max() < 2e-5
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.01


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


@pytest.fixture(scope="module")
def compiled(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eo1")
    artifact, program = once.compiled("whole eo1", lambda to: ttscompile.convert(eo1s.save("plain", folder), to))
    record("LeRobot eo1", "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4", "euler 10", program)
    return artifact


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(compiled: Path, golden: Mapping[str, Array], runtime: str) -> None:
    """The text of the task is an observation, whose tokens the policy makes."""
    policy = ttscompile.load(compiled, runtime=runtime, tokenizer=TOKENIZER)
    assert set(policy.info.observation) == {STATE, *CAMERAS, TOKENS, MASK}
    given = {key: value[None] for key, value in eo1s.observation("plain", 0).items()}
    found = policy.predict_action_chunk(given | {"task": eo1s.TASKS[0]}, noise=Noise(eo1s.noise()), plan="dense")
    assert found.shape == (1, 4, eo1s.ACTION_DIM)
    assert np.abs(found - golden["plain.0"][:, :4]).max() < 1e-4
    with pytest.raises(ObservationError, match=r"has 65 tokens, and the policy reads 64\. Use fewer words"):
        policy.predict_action_chunk(given | {"task": "x" * 65})
    with pytest.raises(ObservationError, match=r"expected float32 \[B, 3, 24, 32\]; found"):
        policy.predict_action_chunk(given | {CAMERAS[0]: np.zeros((1, 3, 30, 21), np.float32), "task": "go"})


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch"])
def test_runtimes_agree_on_random_plans(compiled: Path, runtime: str) -> None:
    assert_agreement_on_random_plans(compiled, runtime)


@pytest.mark.slow
@pytest.mark.soak
def test_in_eight_bits_its_actions_are_near(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(eo1s.save("plain", tmp_path / "saved"), tmp_path / "compiled", precision="int8")
    policy = ttscompile.load(tmp_path / "compiled", tokenizer=TOKENIZER)
    assert (policy.info.default_plan, policy.info.precision) == ("full", "int8")
    given = {key: value[None] for key, value in eo1s.observation("plain", 0).items()}
    found = policy.predict_action_chunk(given | {"task": eo1s.TASKS[0]}, noise=Noise(eo1s.noise()))
    assert 1e-5 < np.abs(found - golden["plain.0"][:, :4]).max() < 0.3
    assert ttscompile.verify(tmp_path / "compiled", calls=1).passed
    lowered = [name for name in load_artifact(tmp_path / "compiled").weights if name.endswith(".int8")]
    assert not [name for name in lowered if "zooms" in name], "images are resized as they are in float32"


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
    assert np.abs(eager(directory, "plain", 0) - golden["plain.0"]).max() < 2e-5


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
    artifact, (_, program) = load_artifact(compiled), once.compiled("whole eo1", lambda _: pytest.fail("made above"))
    assert [block.kind for block in artifact.manifest.blocks] == ["self_attention", "feed_forward"] * 3
    weights = load_file(compiled / "weights.safetensors")
    names = [name for name in weights if name.endswith("gate_proj.weight") and "language_model" in name]
    assert len(names) == 3
    towers = SplitFrames(1000)(program).program.pieces.towers
    assert [each.shape[1:] for tower in towers for each in tower.inputs.values()] == [(3, 24, 32), (3, 30, 27)]


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    assert ttscompile.verify(compiled, calls=1).passed


def test_either_of_the_tied_embeddings_is_enough(directory: Path, golden: Mapping[str, Array]) -> None:
    rename_weight(directory, "model.vlm_backbone.lm_head.weight", EMBEDDING)
    assert np.abs(eager(directory, "plain", 0) - golden["plain.0"]).max() < 2e-5


def test_lerobots_commands_take_it_with_its_task_alone(directory: Path) -> None:
    assert_a_task_alone_makes_files_of_lerobot(directory)


def test_doctor_knows_statistics_and_tokenizer(directory: Path) -> None:
    found = {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1])}
    assert "263 tokens; 273 are known" in found["tokenizer"].found
    assert "5 numbers" in found["normaliser of action"].found


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"use_relative_actions": True}, "use_relative_actions is set, and no step around the policy adds the state"),
        ({"action_act": "mish"}, "action_act is 'mish'; expected linear or gelu"),
        ({"num_action_layers": 3}, "missing action_out_proj.4"),
        ({"max_action_dim": 4}, "max_action_dim is 4; expected at least the 5 numbers"),
        ({"max_state_dim": 8}, r"state_proj.weight has shape \(24, 7\); expected"),
        ({"chunk_size": 7}, "chunk_size is 6; expected 7"),
        ({"vlm_config": None}, "vlm_config is None; expected its entries"),
    ],
)
def test_what_is_not_rebuilt_is_named(directory: Path, changes: dict[str, Any], message: str) -> None:
    change_json(directory / "config.json", **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("text_config", {"use_sliding_window": True}, "use_sliding_window is True; expected false"),
        ("text_config", {"hidden_act": "gelu"}, "hidden_act is 'gelu'; expected silu"),
        ("text_config", {"num_hidden_layers": 2}, "language_model.layers.2"),
        (
            "vision_config",
            {"fullatt_block_indexes": "1"},
            "fullatt_block_indexes is '1'; expected numbers of layers, from 0 to 2",
        ),
        ("vision_config", {"window_size": 4}, "window_size 4; expected .* windows of a token at least"),
        ("vision_config", {"num_heads": 3}, "num_heads 3 .*expected heads of a multiple of 4"),
        ("vision_config", {"in_channels": 1}, "in_channels is 1; expected 3"),
        ("text_config", {"rope_parameters": {"mrope_section": [2, 2]}}, "mrope_section is .*; expected three whole"),
        ("text_config", {"rope_parameters": {"mrope_section": [2, 2, 3]}}, "mrope_section is .*; expected three .* 6"),
        (
            "text_config",
            {"rope_parameters": {"mrope_section": [2, 2, 2], "rope_type": "yarn"}},
            "rope_type is 'yarn'; expected default or mrope",
        ),
    ],
)
def test_a_backbone_that_is_not_rebuilt_is_named(
    directory: Path, part: str, changes: dict[str, Any], message: str
) -> None:
    path = directory / "config.json"
    config = json.loads(path.read_text())["vlm_config"]
    config[part] |= changes
    change_json(path, vlm_config=config)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_mean": [0.5, 0.5, 0.5]}, r"image_mean is \[0.5, 0.5, 0.5\]; expected \[0.48145466"),
        ({"do_resize": False}, "do_resize is False; expected true"),
        ({"merge_size": 1}, "merge_size is 1; expected 2"),
    ],
)
def test_images_that_reach_the_backbone_otherwise(directory: Path, changes: dict[str, Any], message: str) -> None:
    path = directory.parent / eo1s.BACKBONE / "processor_config.json"
    change_json(path, image_processor=json.loads(path.read_text())["image_processor"] | changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"processor_name": "Qwen/Qwen2.5-VL-7B-Instruct"},
            "model 'Qwen/Qwen2.5-VL-7B-Instruct' is not on this machine",
        ),
        ({"image_min_pixels": None}, "image_min_pixels is None; expected a positive whole number"),
        ({"registry_name": "mine"}, "the step 'mine' is not known here"),
        ({"input_features": {}}, r"has the cameras none; expected those of config\.json, observation\.images\.front, "),
        ({"chunk_size": 9}, "chunk_size is 9; expected 6"),
        ({"registry_name": "to_batch_processor"}, "has no eo1_qwen_processor. Save it again"),
    ],
)
def test_a_preprocessor_that_is_not_rebuilt_is_named(directory: Path, changes: dict[str, Any], message: str) -> None:
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    name = "conversation_template" if set(changes) & {"input_features", "chunk_size"} else "qwen"
    (own,) = [step for step in steps if step["registry_name"] == f"eo1_{name}_processor"]
    own["registry_name"] = changes.pop("registry_name", own["registry_name"])
    own["config"] |= changes
    if "processor_name" in changes:
        (directory.parent / eo1s.BACKBONE / "config.json").unlink()
    change_json(path, steps=steps)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


def test_images_that_the_processor_does_not_take_are_named(directory: Path) -> None:
    features = json.loads((directory / "config.json").read_text())["input_features"]
    features[CAMERAS[1]]["shape"] = [3, 4, 804]
    change_json(directory / "config.json", input_features=features)
    with pytest.raises(CheckpointError, match="images of 4 x 804 pixels, .*; expected sides of a ratio of 200 at most"):
        load_checkpoint_policy(directory)


def test_a_chat_template_of_another_model_is_named(directory: Path) -> None:
    (directory.parent / eo1s.BACKBONE / "chat_template.jinja").write_text("{{ messages }}")
    with pytest.raises(CheckpointError, match="its chat template is another one than is rebuilt here; expected Qwen's"):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize("task", ["<|image_pad|>", "push <|state_pad|>"])
def test_what_is_no_text_to_lerobot_is_refused(directory: Path, task: str) -> None:
    with pytest.raises(CheckpointError, match=r"holds <\|, no text to this policy"):
        load_checkpoint_policy(directory, options=LoadOptions(task=task))
    told = load_checkpoint_policy(directory)[1].instruction
    assert told is not None
    with pytest.raises(ObservationError, match="no text to this policy"):
        Tokenizer(TOKENIZER, ObservationError).of_task(task, told, 64)


def test_a_tokenizer_of_another_model_is_named(directory: Path) -> None:
    path = directory / "config.json"
    config = json.loads(path.read_text())["vlm_config"]
    change_json(path, vlm_config=config | {"image_token_id": 5})
    with pytest.raises(CheckpointError, match=r"makes 0 tokens 5 \(image_token_id\) of 2 images"):
        load_checkpoint_policy(directory)
