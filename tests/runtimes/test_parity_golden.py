"""Compiled golden checkpoints against what the original implementations gave, and both runtimes against each other."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import ttscompile
from tests.rounding import PROMISED
from ttscompile import Noise
from ttscompile.artifact import load_artifact
from ttscompile.core.lattice import Source
from ttscompile.ir.program import Program
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.info import PolicyInfo
from ttscompile.runtimes.policy import CompiledPolicy

from ..families.support import record
from ..golden import compiled_golden
from ..once import Once
from .agreement import each_alone, largest_difference

pytestmark = pytest.mark.slow

CHECKPOINTS = ("bert", "ddim8", "inpainting", "mlp_encoder_causal", "transformer_encoder_causal")
EPISODES = ("timestep_95", "mixed_95", pytest.param("mixed_80", marks=pytest.mark.soak))
FAMILIES = {
    "pusht_dpt": "Diffusion Policy, low-dimensional transformer",
    "transformer_encoder_causal": "the same, with a transformer as condition encoder",
    "inpainting": "the same, with the observation in the sample",
    "bert": "the same, encoder only",
}
RUNTIMES = ("onnxruntime", "torch", "reference")

Compiled = Callable[[str], Path]


@pytest.fixture
def converted(shared: Path, once: Once) -> Callable[[str], tuple[Path, Program]]:
    """Artifact and program of a golden checkpoint by name, or of the Push-T policy."""
    return lambda name: compiled_golden(once, shared, name)


@pytest.fixture
def compiled(converted: Callable[[str], tuple[Path, Program]]) -> Compiled:
    """The artifact alone."""
    return lambda name: converted(name)[0]


def worst_of_range(found: npt.NDArray[np.float32], expected: npt.NDArray[np.float32], info: PolicyInfo) -> float:
    """Largest error of an action in units of its range: a normaliser maps the range to -1..1."""
    assert info.action.normalizer is not None
    assert found.shape == expected.shape
    return float((np.abs(found - expected) * np.abs(info.action.normalizer.scale) / 2).max())


def call(policy: CompiledPolicy, recorded: dict[str, npt.NDArray[np.float32]], **more: object) -> dict[str, np.ndarray]:
    noise = Noise(recorded["noise_initial"], recorded["noise_steps"])
    result: dict[str, np.ndarray] = policy.predict_action({"obs": recorded["obs"]}, noise=noise, **more)  # type: ignore[arg-type]
    return result


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("name", CHECKPOINTS)
def test_dense_is_the_original(compiled: Compiled, shared: Path, name: str, runtime: str) -> None:
    recorded = dict(np.load(shared / "golden" / "diffusion_policy" / f"{name}.npz"))
    policy = ttscompile.load(compiled(name), runtime)
    out = call(policy, recorded, plan="dense")
    assert worst_of_range(out["action_pred"], recorded["action_pred"], policy.info) < PROMISED
    assert worst_of_range(out["action"], recorded["action"], policy.info) < PROMISED


@pytest.mark.parametrize("name", FAMILIES)
def test_support_table(converted: Callable[[str], tuple[Path, Program]], name: str) -> None:
    """What was found in each variant is what the README says."""
    program = converted(name)[1]
    table = program.spec.sampler
    against = "actions that the original gave, 1e-5 of the range"
    record(FAMILIES[name], against, f"{table.name} {table.steps}", program)


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("name", EPISODES)
def test_an_episode_with_their_plans_is_what_the_authors_code_gives(
    compiled: Compiled, shared: Path, name: str, runtime: str
) -> None:
    recorded = np.load(shared / "golden" / "tts" / f"{name}.npz")
    policy = ttscompile.load(compiled("pusht_dpt"), runtime)
    policy.reset()
    for r, plan in enumerate(recorded["plans"]):
        one = {key: recorded[key][r] for key in ("obs", "noise_initial", "noise_steps")}
        out = call(policy, one, plan=plan)
        assert worst_of_range(out["action_pred"], recorded["action_pred"][r], policy.info) < PROMISED
        report = policy.last_report
        assert report is not None
        assert report.computed == (int(np.count_nonzero(plan == Source.COMPUTE)),)
        assert report.legalised == (0,)


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_both_runtimes_agree_on_random_plans(compiled: Compiled, name: str) -> None:
    """An episode of three calls of two streams. Toys go through many more, of one to four streams."""
    artifact = load_artifact(compiled(name))
    runtimes = open_runtime(artifact, "onnxruntime"), open_runtime(artifact, "reference")
    assert largest_difference(artifact, *runtimes, np.random.default_rng(0), streams=2, calls=3) < PROMISED


@pytest.mark.parametrize("name", ["transformer_encoder_causal", "inpainting"])
def test_a_batch_of_streams_is_its_streams_one_by_one(compiled: Compiled, name: str) -> None:
    for beside, alone in each_alone(load_artifact(compiled(name)), np.random.default_rng(0), 2, calls=2):
        assert np.abs(beside - alone).max() < PROMISED * np.abs(alone).max()
