"""The yardstick beside the errors of plans: how far two dense answers with different noise are apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import draw_noise
from ttscompile.calibration.judge import WITH_OTHER_NOISE, dense_with_other_noise
from ttscompile.calibration.result import CalibrationResult, PlanScore
from ttscompile.report import facts

from . import policies, tasks

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


@pytest.mark.parametrize("count", [1, 5, 40])
def test_the_distance_of_known_answers(constant: Path, recording: Path, count: int) -> None:
    task = tasks.make_task(constant, recording, calls=count)
    artifact = load_artifact(constant)
    found = dense_with_other_noise(artifact, task.executor, task.calls, seed=7)
    some = min(count, WITH_OTHER_NOISE)
    initial, noise = draw_noise(artifact.manifest.spec, some, (7, 5))
    other = answer(initial.numpy(), noise.numpy())
    own = answer(task.calls.initial[:some].numpy(), task.calls.noise[:, :some].numpy())
    assert found == pytest.approx(np.abs(other - own).mean(), rel=1e-4)
    assert found > 0.01
    assert found == dense_with_other_noise(artifact, task.executor, task.calls, seed=7)
    assert found != dense_with_other_noise(artifact, task.executor, task.calls, seed=8)


def result(other_noise: float | None) -> CalibrationResult:
    return CalibrationResult(
        strategy="tts",
        seed=0,
        target_sparsity=0.9,
        default_plan="schedule",
        plans={"schedule": PlanScore(2.5, 3.0, 0.9, 0.9, 0.9), "fast": PlanScore(8.0, 9.0, 0.95, 0.95, 0.95)},
        episodes={},
        calls={},
        intervals=1,
        stopped="finished",
        seconds=1.0,
        other_noise=other_noise,
    )


def test_record_table_and_words_say_the_ratio() -> None:
    record = result(10.0).record()
    assert record["other_noise"] == 10.0
    assert [plan["of_other_noise"] for plan in record["plans"].values()] == [0.25, 0.8]
    table = facts.score_table(record)
    column = table.head.index("/ other noise")
    assert [(row[0], row[column]) for row in table.rows] == [("schedule", "0.25"), ("fast", "0.80")]
    (told,) = facts.other_noise(record)
    assert "Two dense calls with different noise are 10 apart" in told
    assert "'What an error means'" in told
    assert all("other noise" not in row[0] for row in facts.record_table(record).rows), "told once"


@pytest.mark.parametrize("other_noise", [None, 0.0])
def test_without_a_distance_there_is_no_ratio(other_noise: float | None) -> None:
    """An artifact of an earlier version, and a policy that answers the same whatever the noise."""
    record = result(other_noise).record()
    assert all("of_other_noise" not in plan for plan in record["plans"].values())
    assert "/ other noise" not in facts.score_table(record).head
    assert len(facts.other_noise(record)) == (other_noise is not None)


def test_the_sentence_is_of_a_section_that_is_there() -> None:
    page = (Path(__file__).parents[2] / "docs" / "evidence" / "results.md").read_text()
    assert "## What an error means" in page
