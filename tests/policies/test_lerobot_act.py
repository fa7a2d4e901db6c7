"""LeRobot's ``act``, against numbers that lerobot gave; see ``golden/make_lerobot_act.py``."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import ttscompile
from tests.rounding import PROMISED
from ttscompile.artifact.load import load_artifact
from ttscompile.cli import main
from ttscompile.core.spec import Noise
from ttscompile.errors import TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.program import Program
from ttscompile.policies.lerobot.config import ENVIRONMENT, STATE

from ..families.support import record
from ..once import Once
from . import acts
from .acts import ACTION_DIM, CHUNK, STREAMS, TOP, WRIST
from .lerobot_tiny import changed_policy
from .originals import golden
from .refused import assert_not_read

COMPILED = "two_cameras"


def noise(seed: int = 0) -> Noise:
    """Which nothing may depend on."""
    drawn = np.random.default_rng(seed).standard_normal((STREAMS, CHUNK, ACTION_DIM), dtype=np.float32)
    return Noise(drawn)


@pytest.mark.parametrize("variant", acts.VARIANTS)
def test_lerobot_gave_the_same(variant: str, tmp_path: Path) -> None:
    """The whole chunk, and what is executed in the robot's units, from the files that are saved."""
    module, spec = load_checkpoint_policy(acts.save(variant, tmp_path / "policy"))
    numbers, observation = golden(f"lerobot_act_{variant}"), acts.observation(variant)
    assert set(spec.observations) == set(observation)
    given = {key: torch.from_numpy(value) for key, value in observation.items()}
    sample = eager_policy(module, spec)(given, noise()).numpy()
    expected = numbers["action_normalized"]
    assert np.abs(sample - expected).max() < PROMISED * np.ptp(expected)
    executed = spec.chunk.unnormalized(sample)[:, spec.chunk.start : spec.chunk.stop]
    assert executed.shape == numbers["action"].shape
    assert np.abs(executed - numbers["action"]).max() < PROMISED * np.ptp(numbers["action"])


@pytest.mark.parametrize("variant", acts.VARIANTS)
def test_every_observation_matters(variant: str, tmp_path: Path) -> None:
    """Each changes the actions by more than what is allowed above."""
    module, spec = load_checkpoint_policy(acts.save(variant, tmp_path / "policy"))
    policy = eager_policy(module, spec)
    given = {key: torch.from_numpy(value) for key, value in acts.observation(variant).items()}
    before = policy(given, noise())
    for key, value in given.items():
        changed = policy({**given, key: 1 - value}, noise())
        assert float((changed - before).abs().max()) > 100 * PROMISED * float(before.max() - before.min()), key


# Compiled


@pytest.fixture(scope="module")
def compiled(once: Once) -> tuple[Path, Program]:
    """The policy of two cameras, converted once, in eight bits too: its folder and program."""

    def convert(directory: Path) -> Program:
        saved = acts.save(COMPILED, directory.parent / "policy")
        return ttscompile.convert(saved, directory, precision="int8")

    return once.compiled("lerobot act", convert)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference", "torch"])
def test_compiled_is_lerobot(compiled: tuple[Path, Program], runtime: str) -> None:
    """From the robot's own observations to actions in its units, through the artifact, whatever the noise."""
    expected = golden(f"lerobot_act_{COMPILED}")["action"]
    policy = ttscompile.load(compiled[0], runtime=runtime, plan="dense")
    observation = acts.observation(COMPILED)
    found = policy.predict_action(observation)["action"]
    assert np.abs(found - expected).max() < PROMISED * np.ptp(expected)
    for seed in range(2):
        policy.reset()
        np.testing.assert_array_equal(policy.predict_action(observation, noise=noise(seed))["action"], found)


@pytest.mark.slow
def test_select_action_is_lerobots(compiled: tuple[Path, Program]) -> None:
    """One frame, and then an action a tick from the queue."""
    policy, expected = ttscompile.load(compiled[0], plan="dense"), golden(f"lerobot_act_{COMPILED}")["action"]
    frame = {key: torch.from_numpy(value[:, 0]) for key, value in acts.observation(COMPILED).items()}
    found = [policy.select_action(frame) for _ in range(expected.shape[1])]
    assert all(isinstance(each, torch.Tensor) and each.shape == (STREAMS, ACTION_DIM) for each in found)
    assert np.abs(torch.stack(found, dim=1).numpy() - expected).max() < PROMISED * np.ptp(expected)


@pytest.mark.slow
def test_nothing_is_left_in_the_loop(compiled: tuple[Path, Program]) -> None:
    """Images are towers, all else is computed once a call; the loop copies. Frames that were seen are remembered."""
    program = compiled[1]
    record(
        "LeRobot act (one evaluation, nothing to reuse)",
        "actions that lerobot 0.6.1 gave, raw observation to action, 1e-5 of the range",
        "direct 1",
        program,
    )
    assert len(program.pieces.towers) == 2
    assert len(program.blocks) == 1
    left = sum(graph_flops(piece.graph) for piece in program.pieces.loop.values())
    assert left < 1e-3 * program.dense_flops
    policy = ttscompile.load(compiled[0], plan="dense")
    one = {key: value[:1] for key, value in acts.observation(COMPILED).items()}
    for expected in (2, 0):
        policy.predict_action(one)
        assert policy.last_report is not None and policy.last_report.frames.computed == expected


@pytest.mark.slow
def test_eight_bits_are_near(compiled: tuple[Path, Program]) -> None:
    """Towers and transformer; of a random network that magnifies errors, so the bound is wide."""
    record_ = load_artifact(compiled[0]).manifest.precision
    assert record_ is not None and {"frame_00", "frame_01", "condition"} == set(record_.kept)
    observation = {key: value[:1] for key, value in acts.observation(COMPILED).items()}
    exact, near = (
        ttscompile.load(compiled[0], plan=plan).predict_action(observation)["action"] for plan in ("dense", "full")
    )
    assert 0 < np.abs(near - exact).max() < 0.1 * np.ptp(exact)


@pytest.mark.slow
def test_the_commands_say_that_there_is_nothing_to_reuse(compiled: tuple[Path, Program]) -> None:
    """No warning about too few steps, as if other ones were better; ``verify`` holds."""
    shown = CliRunner().invoke(main, ["inspect", str(compiled[0])])
    assert shown.exit_code == 0 and "nothing to reuse between steps" in shown.output
    held = CliRunner().invoke(main, ["verify", str(compiled[0])])
    assert held.exit_code == 0, held.output


# Settings


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of two cameras whose files a test may replace by others in a folder of its own."""
    return acts.save(COMPILED, tmp_path_factory.mktemp("lerobot_act") / "policy")


@pytest.fixture
def changed(saved: Path, tmp_path: Path) -> Callable[..., Path]:
    """The same policy with entries of its ``config.json``, or some of its weights, changed."""

    return partial(changed_policy, saved, tmp_path / "changed")


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "frames": ({"n_obs_steps": 2}, r"n_obs_steps is 2; expected 1"),
    "other ResNet": ({"vision_backbone": "resnet34"}, r"missing model\.backbone\.layer1\.2"),
    "deeper ResNet": (
        {"vision_backbone": "resnet50"},
        r"vision_backbone is 'resnet50', .*expected resnet18 or resnet34, and false\. .*DirectDenoiser",
    ),
    "dilation": ({"replace_final_stride_with_dilation": True}, r"replace_final_stride_with_dilation True; expected"),
    "width": ({"dim_model": 34}, r"dim_model is 34; expected a multiple of n_heads = 4, and of 4"),
    "heads": ({"n_heads": 5}, r"dim_model is 32; expected a multiple of n_heads = 5"),
    "activation": ({"feedforward_activation": "glu"}, r"feedforward_activation is 'glu'; expected relu or gelu"),
    "order": ({"pre_norm": True}, r"missing model\.encoder\.norm"),
    "layers": ({"n_decoder_layers": 2}, r"missing model\.decoder\.layers\.1"),
    "many layers": ({"n_encoder_layers": 10**6}, r"n_encoder_layers is 1000000; expected .*256 at most"),
    "executed": ({"n_action_steps": 7}, r"n_action_steps is 7; expected chunk_size = 6 at most"),
    "chunk": ({"chunk_size": 5}, r"decoder_pos_embed\.weight has shape \(6, 32\); expected \(5, 32\)"),
    "nothing seen": (
        {"input_features": {STATE: {"type": "STATE", "shape": [4]}}},
        rf"input_features have neither a camera nor '{ENVIRONMENT}'",
    ),
    "missing": ({"weights": lambda w: w.pop("model.action_head.bias")}, r"missing model\.action_head\.bias"),
    "extra": ({"weights": lambda w: w.update(extra=torch.ones(1))}, r"unexpected extra"),
    "not finite": (
        {"weights": lambda w: w["model.action_head.bias"].fill_(float("nan"))},
        r"action_head\.bias holds 3 values that are not finite",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_settings_that_do_not_fit(changed: Callable[..., Path], case: str) -> None:
    """Each is named, with what was expected, and the directory."""
    given, message = BAD[case]
    directory = changed(**given)
    assert_not_read(directory, message, error=TtscompileError, names=directory)


def test_the_autoencoder_is_not_read(changed: Callable[..., Path]) -> None:
    """Its weights may be damaged, or absent, as after a training without it."""

    def damage(weights: dict[str, torch.Tensor]) -> None:
        for name in [name for name in weights if ".vae_encoder" in name]:
            weights[name].fill_(float("nan")) if name.endswith("bias") else weights.pop(name)

    module, spec = load_checkpoint_policy(changed(weights=damage))
    given = {key: torch.from_numpy(value) for key, value in acts.observation(COMPILED).items()}
    expected = golden(f"lerobot_act_{COMPILED}")["action_normalized"]
    found = eager_policy(module, spec)(given, noise()).numpy()
    assert np.abs(found - expected).max() < PROMISED * np.ptp(expected)


@pytest.mark.parametrize("option", ["task", "encoders", "sampler", "steps", "spacing"])
def test_options_of_other_types(saved: Path, option: str) -> None:
    """There is no instruction, and no loop to choose."""
    options = LoadOptions(**dict[str, Any]({option: 4 if option == "steps" else "ddim"}))
    assert_not_read(saved, f"the option {option} is for other .*act, gives .*Leave it out", options=options)


def test_loops_that_a_build_offers_are_left_out(saved: Path) -> None:
    """There is one alone, of one step without noise."""
    _, spec = load_checkpoint_policy(saved, options=LoadOptions(loops=(("ddim", 16),)))
    assert list(spec.all_loops) == ["original"]
    assert (spec.sampler.name, spec.sampler.steps, spec.sampler.stochastic) == ("direct", 1, False)
    assert (spec.chunk.start, spec.chunk.stop, spec.source["policy"]) == (0, 4, "act")


def test_temporal_ensembling_is_told(changed: Callable[..., Path]) -> None:
    """Chunks are executed as they are; what to do about it is said."""
    directory = changed(temporal_ensemble_coeff=0.01, n_action_steps=1)
    with pytest.warns(UserWarning, match="no temporal ensembling: it takes the first 1 .* The executor does it"):
        _, spec = load_checkpoint_policy(directory)
    assert (spec.chunk.start, spec.chunk.stop) == (0, 1)


def test_defaults_are_lerobots(changed: Callable[..., Path]) -> None:
    """Of what a file leaves out."""
    inputs = {TOP: {"type": "VISUAL", "shape": [3, 64, 96]}, WRIST: {"type": "VISUAL", "shape": [3, 64, 96]}}
    directory = changed(input_features=inputs)
    saved = {"type": "act", "input_features": inputs, "output_features": {"action": {"type": "ACTION", "shape": [3]}}}
    (directory / "config.json").write_text(json.dumps(saved), encoding="utf-8")
    config = acts.config_of(directory)
    assert (config.chunk_size, config.dim_model, config.n_heads, config.dim_feedforward) == (100, 512, 8, 3200)
    assert (config.n_encoder_layers, config.n_decoder_layers, config.latent_dim) == (4, 1, 32)
    assert (config.vision_backbone, config.pre_norm, config.gelu) == ("resnet18", False, False)
    assert config.vectors == {}
