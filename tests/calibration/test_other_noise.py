"""The yardstick beside the errors of plans: how far two dense answers with different noise are apart."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.once import Once
from ttscompile.artifact.ceiling import FARTHEST
from ttscompile.calibration.judge import Score, other_noise, other_observations
from ttscompile.calibration.pipeline import CalibrationResult
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.recordings import UNHEARD, warn_if_noisy
from ttscompile.calibration.trials import DRAWS
from ttscompile.report import facts

from . import policies
from .tasks import trials_of

NOISE = 0.05


@pytest.fixture(scope="module")
def constant(once: Once) -> Path:
    """Predicts the same for every sample, so that its answer is the noise, a quarter less of it at each step."""
    module = policies.Mixer(2).eval()
    with torch.no_grad():
        module.head.weight.zero_()
    spec = policies.spec(NOISE)
    return once.compiled("constant mixer", lambda directory: ttscompile.compile_denoiser(module, spec, directory))[0]


def answer(initial: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """What of the answer is noise, in the units of the executed actions."""
    sample = initial
    for k in range(policies.STEPS):
        sample = 0.75 * sample + (NOISE * noise[k] if k < policies.STEPS - 1 else 0)
    return sample[:, 1:5] / np.array([0.5, 2.0])


@pytest.mark.slow
@pytest.mark.parametrize("most", [2, 5, 32])
def test_the_distance_of_known_answers(constant: Path, recording: Path, tmp_path: Path, most: int) -> None:
    trials = trials_of(constant, recording, tmp_path, seed=7, observations=most)
    sample, spec = trials.held_out, trials.artifact.manifest.spec
    assert 1 <= len(sample.calls) <= most
    apart = []
    for stretch, row in sample.calls.tolist():
        noise = trials.noise(spec, [trials.noise_key(sample.part, stretch, row, draw) for draw in range(DRAWS)])
        assert noise.steps is not None
        answers = answer(noise.initial, noise.steps)
        apart += [np.abs(answers[i] - answers[j]).mean() for i, j in combinations(range(DRAWS), 2)]
    assert other_noise(trials) == pytest.approx(np.mean(apart), rel=1e-4)
    assert other_noise(trials) > 0.01
    same, other = (trials_of(constant, recording, tmp_path, seed=seed, observations=most) for seed in (7, 8))
    assert other_noise(trials) == other_noise(same) != other_noise(other)


def result(other_noise: float | None) -> CalibrationResult:
    def score(distance: float, error: float, more: float, sparsity: float) -> Score:
        return Score(distance, (0.0, 1.0), error, more, sparsity, sparsity, sparsity, plans=1)

    return CalibrationResult(
        learned=("schedule",),
        seed=0,
        target_sparsity=0.9,
        default_plan="schedule",
        plans={"schedule": score(0.2, 2.5, 3.0, 0.9), "fast": score(0.7, 8.0, 9.0, 0.95)},
        episodes={},
        calls={},
        intervals=1,
        stopped="finished",
        seconds=1.0,
        other_noise=other_noise,
    )


def test_the_record_has_other_noise_and_the_table_distances_alone() -> None:
    """Two yardsticks beside each other were taken for one."""
    record = result(10.0).record()
    assert record["other_noise"] == 10.0
    table = facts.score_table(record)
    assert not [name for name in table.head if "noise" in name]
    assert all("other noise" not in row[0] for row in (*table.rows, *facts.record_table(record).rows))


@pytest.mark.parametrize(
    ("distance", "budget", "doubtful"),
    [
        (FARTHEST, {"target_sparsity": 0.9}, False),
        (FARTHEST + 0.01, {"target_sparsity": 0.9}, True),
        (FARTHEST + 0.01, {"max_action_error": 8.0}, False),  # who names an error knows what it means
        (FARTHEST + 0.01, {"max_distance": 0.9}, False),
        (FARTHEST + 0.01, {"latency_ms": 8.0}, True),
    ],
)
def test_a_plan_that_is_far_off_is_doubtful(distance: float, budget: dict[str, float], doubtful: bool) -> None:
    """By the default plan alone: ``fast`` may be far off."""
    made = result(10.0)
    plans = {**made.plans, "schedule": replace(made.plans["schedule"], distance=distance)}
    assert replace(made, plans=plans, budget=budget).doubtful == doubtful


@pytest.mark.parametrize(
    ("distance", "word"), [(FARTHEST, "within"), (FARTHEST + 0.01, "above"), (float("nan"), "above"), ("far", "")]
)
def test_a_record_has_a_verdict(distance: object, word: str) -> None:
    record = result(10.0).record()
    record["plans"]["schedule"]["distance"] = distance
    assert [one for one in facts.remarks(record) if "What a distance means" in one] == list(facts.verdict(record))
    assert (word in "".join(facts.verdict(record))) and bool(facts.verdict(record)) == bool(word)


@pytest.mark.parametrize(("shift", "calls", "warned"), [(1.0, 8, False), (0.0, 8, True), (0.0, 1, False)])
def test_a_policy_that_hardly_heeds_what_was_recorded_is_told_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shift: float, calls: int, warned: bool
) -> None:
    """Four answers to each of eight observations: with other noise 0.1 apart on average, with others as far or more.

    With one observation nothing is known of others.
    """
    spec = policies.spec()
    answers = (
        np.random.default_rng(0).normal(0, 0.1, (8, DRAWS, *spec.sample)) + shift * np.arange(8)[:, None, None, None]
    )
    sample = SimpleNamespace(answers=answers[:calls].astype(np.float32))
    held: Any = SimpleNamespace(artifact=SimpleNamespace(manifest=SimpleNamespace(spec=spec)), held_out=sample)
    held.bar = Bar(shown=True)
    assert (other_noise(held) < UNHEARD * other_observations(held)) == (calls > 1 and not warned)
    warn_if_noisy(held)
    assert ("hardly heeds what was recorded" in capsys.readouterr().err) == warned


@pytest.mark.parametrize("apart", [None, 0.0, 10.0])
def test_where_noise_changes_nothing_another_unit_is_named(apart: float | None) -> None:
    told = facts.remarks(result(apart).record())
    assert sum("a tenth of what another observation changes" in one for one in told) == (apart == 0)
