"""What was computed for one episode is never read in another, whatever happened in between."""

import numpy as np
import pytest

from ttscompile import Source
from ttscompile.artifact import Artifact
from ttscompile.core.lattice import dense_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.runtimes import Runtime, open_runtime

from .agreement import random_inputs
from .conftest import Failure, failing_prologue

RUNTIMES = ["onnxruntime", "torch", "reference"]


def episode(artifact: Artifact, name: str, inputs: list[tuple[dict[str, np.ndarray], object]]) -> list[np.ndarray]:
    """The same calls on a runtime that has done nothing else."""
    runtime = open_runtime(artifact, name)
    return [runtime.predict(obs, noise, Plan(repair=True))[0] for obs, noise in inputs]  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNTIMES)
@pytest.mark.parametrize("seed", range(2))
def test_any_sequence_of_calls_resets_failures_and_refusals(
    pruned: Artifact, name: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every answer is that of a new runtime to the calls since the episode began."""
    draw, runtime = np.random.default_rng(seed), open_runtime(pruned, name)
    streams, since, read = 2, list[tuple[dict[str, np.ndarray], object]](), 0
    for what in draw.choice(["call", "reset", "fail", "refused"], 24, p=[0.7, 0.1, 0.1, 0.1]):
        obs, noise = random_inputs(pruned, draw, streams)
        if what == "call":
            since.append((obs, noise))
            found, report = runtime.predict(obs, noise, Plan(repair=True))
            read += int((report.plan == Source.ROLLOUT).sum())
            assert np.array_equal(found, episode(pruned, name, since)[-1])
        elif what == "refused":  # before anything was done: the episode goes on
            with pytest.raises(IllegalPlanError):
                runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)[:, :4]))
        elif what == "reset":
            runtime.reset()
            streams, since = int(draw.integers(1, 4)), []
        else:
            with failing_prologue(monkeypatch), pytest.raises((Failure, ArtifactError)):
                runtime.predict(obs, noise, Plan(repair=True))
            since = []
    assert read >= 10  # else nothing could have leaked


@pytest.mark.parametrize("name", RUNTIMES)
def test_a_stream_is_the_same_beside_any_others(pruned: Artifact, name: str) -> None:
    """Two batches share one stream and nothing else: its answers are the same, call after call."""
    draw, reads = np.random.default_rng(7), 0
    batches: list[Runtime] = [open_runtime(pruned, name) for _ in range(2)]
    for _ in range(5):
        (obs, noise), (other, others) = (random_inputs(pruned, draw, 3) for _ in range(2))
        mixed = {key: np.concatenate([other[key][:1], obs[key][1:2], other[key][2:]]) for key in obs}
        initial = np.concatenate([others.initial[:1], noise.initial[1:2], others.initial[2:]])
        assert noise.steps is not None
        assert others.steps is not None
        steps = np.concatenate([others.steps[:, :1], noise.steps[:, 1:2], others.steps[:, 2:]], axis=1)
        (one, report), (two, _) = (
            batches[0].predict(obs, noise, Plan(repair=True)),
            batches[1].predict(mixed, type(noise)(initial, steps), Plan(repair=True)),
        )
        np.testing.assert_allclose(one[1], two[1], rtol=1e-4, atol=1e-5)
        assert np.abs(one[0] - two[0]).max() > 1e-3
        reads += int((report.plan[1] == Source.ROLLOUT).sum())
    assert reads > 0
