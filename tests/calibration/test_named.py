"""Plans beside the target: safe and fast."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import step_counts, whole_steps
from ttscompile.calibration.pipeline import CalibrationResult, calibrate
from ttscompile.core.lattice import Source
from ttscompile.errors import IllegalPlanError

from . import policies

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def calibrated(
    compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CalibrationResult]:
    """Four of ten steps; not to be changed."""
    directory = Path(shutil.copytree(compiled, tmp_path_factory.mktemp("named") / "compiled"))
    return directory, calibrate(directory, [recording], 0.6, progress=False, max_minutes=1)


def computed(artifact: Path, name: str) -> list[int]:
    plan = load_artifact(artifact).plans[name].cells
    assert plan is not None
    rows = (plan == Source.COMPUTE).all(1)
    np.testing.assert_array_equal((plan == Source.COMPUTE).any(1), rows)  # whole steps
    return [int(k) for k in np.flatnonzero(rows)]


def test_safe_computes_twice_as_much_and_fast_half_each_with_its_own_score(
    calibrated: tuple[Path, CalibrationResult],
) -> None:
    artifact, result = calibrated
    loaded = load_artifact(artifact)
    assert {name: len(computed(artifact, name)) for name in ("safe", "schedule", "fast")} == {
        "safe": 8,
        "schedule": 4,
        "fast": 2,
    }
    error = policies.errors(result)
    assert error["safe"] < error["schedule"] < error["fast"]
    assert result.plans["safe"].distance < result.plans["schedule"].distance < result.plans["fast"].distance
    corrections = [loaded.plans[name].correction for name in ("safe", "schedule", "fast")]
    weights = [one.weights.tobytes() for one in corrections if one is not None]
    assert len(set(weights)) == 3
    record = loaded.manifest.calibration
    assert record is not None
    assert record["named_steps"] == {name: computed(artifact, name) for name in ("safe", "fast")}
    assert record["plans"]["safe"]["error"] == pytest.approx(result.plans["safe"].error)
    assert record["skipped"] == {}


def test_a_plan_is_chosen_when_loading_or_calling(calibrated: tuple[Path, CalibrationResult]) -> None:
    artifact, result = calibrated
    policy = ttscompile.load(artifact, plan="safe", seed=0)
    obs = {"obs": np.zeros((1, 2, 3), np.float32)}
    assert policy.info.default_plan == "safe"
    assert result.default_plan in policy.info.plans
    safe = policy.predict_action(obs)["action"]
    assert policy.last_report is not None
    assert policy.last_report.plan_name == "safe"
    policy.predict_action(obs, plan="fast")
    assert policy.last_report.plan_name == "fast"
    assert policy.last_report.computed == (12,)
    named = ttscompile.load(artifact, seed=0).predict_action(obs, plan="safe")["action"]
    np.testing.assert_array_equal(safe, named)
    with pytest.raises(IllegalPlanError, match=r"no plan 'swift'; it has \['dense', 'fast', 'safe'"):
        ttscompile.load(artifact, plan="swift")


def test_what_cannot_be_made_is_said(artifact: Path, recording: Path) -> None:
    result = calibrate(artifact, [recording], 0.8, progress=False, max_minutes=1)
    assert result.skipped == {"fast": "would compute too little: half of the target's 2 whole steps"}
    assert len(computed(artifact, "safe")) == 4
    result = calibrate(artifact, [recording], 0.5, progress=False, max_minutes=1)
    assert result.skipped == {"safe": "would be the dense plan: twice 5 of 10 steps"}
    assert len(computed(artifact, "fast")) == 2
    result = calibrate(artifact, [recording], 0.5, learn=("interval",), progress=False, max_minutes=1)
    assert set(result.skipped) == {"safe", "fast"}
    assert "needs a correction: 'interval' fits none" in result.skipped["safe"]
    record = load_artifact(artifact).manifest.calibration
    assert record is not None
    assert record["skipped"] == dict(result.skipped)
    assert set(load_artifact(artifact).plans) == {"dense", "schedule", "uniform"}


def test_a_search_for_safe_that_is_cut_short_is_no_finished_one(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = whole_steps.WholeSteps.comparing
    monkeypatch.setattr(
        whole_steps.WholeSteps, "comparing", lambda self, count: whole(self, count) if count < 8 else float("inf")
    )
    result = calibrate(artifact, [recording], 0.6, progress=False, max_minutes=1)
    assert (result.stopped, result.skipped["safe"]) == ("time limit", "found no time within the limit")


def test_a_plan_that_is_no_safer_is_left_out_with_the_reason(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time limit ends the search for ``safe`` at its first candidate, which is bad."""
    monkeypatch.setattr(step_counts.SpacedSchedules, "best", lambda *_: step_counts.Best(tuple(range(8)), 1.0))
    result = calibrate(artifact, [recording], 0.6, progress=False, max_minutes=1)
    assert "safe" not in result.plans
    assert result.skipped["safe"].endswith("from the original, no safer than schedule: its search was cut short")
    loaded = load_artifact(artifact)
    assert "safe" not in loaded.manifest.plans
