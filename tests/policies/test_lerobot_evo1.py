"""Parity with LeRobot 0.6.1's evo1 at tiny sizes: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

import ttscompile
from tests.once import Once
from ttscompile.core.spec import Noise
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions

from ..families.support import record
from . import evo1s, originals
from .lerobot_tiny import change_json
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import assert_a_task_alone_makes_files_of_lerobot, assert_agreement_on_random_plans, eager_chunk

STATISTICS = "policy_preprocessor_step_4_normalizer_processor.safetensors"


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_evo1")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return evo1s.save("words", tmp_path)


def eager(directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled."""
    told = directory.parent / evo1s.LANGUAGE, evo1s.TASKS[call]
    return eager_chunk(directory, options, evo1s.observation(call), evo1s.noise(kind), *told)[1]


@pytest.mark.parametrize("kind", evo1s.KINDS)
@pytest.mark.parametrize("compiled_in", [False, True])
def test_the_rebuilt_network_gives_lerobots_actions(
    tmp_path: Path, kind: str, compiled_in: bool, golden: Mapping[str, Array]
) -> None:
    """Two instructions, states and image sizes; and a camera that the robot lacks."""
    directory = evo1s.save(kind, tmp_path)
    for call in (0, 1):
        options = LoadOptions(task=evo1s.TASKS[call] if compiled_in else None)
        found = eager(directory, kind, call, options)
        assert found.shape == golden[f"{kind}.{call}"].shape
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < 1e-4
        assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01
    without = LoadOptions(task=evo1s.TASKS[0] if compiled_in else None, without_cameras=CAMERAS[:1])
    found = eager(directory, kind, 0, without)
    assert np.abs(found - golden[f"{kind}.missing"]).max() < 1e-4
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.001


@pytest.fixture(scope="module")
def compiled(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evo1")
    artifact, program = once.compiled("whole evo1", lambda to: ttscompile.convert(evo1s.save("words", folder), to))
    record("LeRobot evo1", "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4", "euler 4", program)
    return artifact


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(compiled: Path, golden: Mapping[str, Array], runtime: str) -> None:
    """The text of the task is an observation, whose tokens the policy makes."""
    policy = ttscompile.load(compiled, runtime=runtime, tokenizer=evo1s.SAVED / "words" / evo1s.LANGUAGE)
    assert set(policy.info.observation) == {STATE, *CAMERAS, TOKENS, MASK}
    for call in (0, 1):
        given = {key: value[None] for key, value in evo1s.observation(call).items()} | {"task": evo1s.TASKS[call]}
        found = policy.predict_action_chunk(given, noise=Noise(evo1s.noise("words")), plan="dense")
        assert found.shape == (1, 4, 5)
        assert np.abs(found - golden[f"words.{call}"][:, :4]).max() < 1e-4


@pytest.mark.slow
def test_runtimes_agree_on_random_plans(compiled: Path) -> None:
    assert_agreement_on_random_plans(compiled, "onnxruntime")


@pytest.mark.slow
@pytest.mark.soak
def test_in_eight_bits_its_actions_are_near(tmp_path: Path, golden: Mapping[str, Array]) -> None:
    ttscompile.convert(evo1s.save("words", tmp_path / "saved"), tmp_path / "compiled", precision="int8")
    policy = ttscompile.load(tmp_path / "compiled", tokenizer=evo1s.SAVED / "words" / evo1s.LANGUAGE)
    assert (policy.info.default_plan, policy.info.precision) == ("full", "int8")
    given = {key: value[None] for key, value in evo1s.observation(0).items()} | {"task": evo1s.TASKS[0]}
    found = policy.predict_action_chunk(given, noise=Noise(evo1s.noise("words")))
    assert 1e-5 < np.abs(found - golden["words.0"][:, :4]).max() < 0.2


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    assert ttscompile.verify(compiled, calls=1).passed


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
    assert np.abs(eager(directory, "words", 0) - golden["words.0"]).max() < 1e-4
    whole["observation.state.max"][5] = 2
    path.unlink()
    save_file(whole, path)
    with pytest.raises(CheckpointError, match=r"observation.state.max has shape \(7,\); expected \(4,\)"):
        load_checkpoint_policy(directory)


def test_lerobots_commands_take_it_with_its_task_alone(directory: Path) -> None:
    assert_a_task_alone_makes_files_of_lerobot(directory)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_head": "diffusion"}, "action_head is 'diffusion'; expected flowmatching"),
        ({"binarize_gripper": True}, "binarize_gripper is True; expected false: .* is the robot's to do"),
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
        ({"vlm_model_name": "elsewhere/internvl"}, "'elsewhere/internvl' is not on this machine"),
    ],
)
def test_what_is_not_rebuilt_is_named(directory: Path, changes: dict[str, Any], message: str) -> None:
    if "vlm_model_name" in changes:
        (directory.parent / evo1s.LANGUAGE / "config.json").unlink()
    change_json(directory / "config.json", **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("vision_config", {"use_qk_norm": True}, "vision_config.use_qk_norm is True; expected false: another"),
        ("vision_config", {"norm_type": "rms_norm"}, "norm_type is 'rms_norm'; expected layer_norm"),
        ("vision_config", {"patch_size": [7, 14]}, "patch_size is .*; expected a square"),
        ("text_config", {"model_type": "qwen3"}, "text_config.model_type is 'qwen3'; expected qwen2"),
        ("text_config", {"use_sliding_window": True}, "use_sliding_window is True; expected false"),
        ("text_config", {"max_position_embeddings": 64}, "max_position_embeddings is 64; expected at least .*, 100"),
        ("text_config", {"rope_parameters": {"rope_type": "yarn"}}, "rope_type is 'yarn'; expected default or dynamic"),
        (None, {"vision_feature_layer": -2}, "vision_feature_layer is -2; expected -1"),
        (None, {"downsample_ratio": 0.3}, "downsample_ratio is 0.3; expected one of"),
        (None, {"image_seq_length": 5}, "image_seq_length is 5; expected 4"),
        (None, {"image_token_id": 3}, "makes 0 tokens 3 .* in a prompt of 3 images"),
        (None, {"text_config": None}, "text_config is None; expected its entries"),
    ],
)
def test_what_is_not_rebuilt_of_the_language_model_is_named(
    directory: Path, part: str | None, changes: dict[str, Any], message: str
) -> None:
    path = directory.parent / evo1s.LANGUAGE / "config.json"
    own = changes if part is None else {part: json.loads(path.read_text())[part] | changes}
    change_json(path, **own)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_policy(directory)


def test_a_tokenizer_that_is_missing(directory: Path) -> None:
    (directory.parent / evo1s.LANGUAGE / "tokenizer.json").unlink()
    with pytest.raises(CheckpointError, match=r"the tokenizer 'internvl-tiny' is not on this machine.*command line\.$"):
        load_checkpoint_policy(directory)
