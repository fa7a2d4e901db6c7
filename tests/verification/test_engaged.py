"""What a plan saves in time is judged by medians of calls in turn, with a clock that the test moves."""

from dataclasses import replace
from pathlib import Path

import pytest

import ttscompile
from ttscompile.artifact.golden import load_golden
from ttscompile.artifact.load import load_artifact
from ttscompile.verification import reuse
from ttscompile.verification.reuse import check_engaged
from ttscompile.verification.rung import FAILED, PASSED, SKIPPED, Rung

from .timed import Timed


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else this machine does."""
    monkeypatch.setattr(reuse, "busy", lambda: None)


def judged(
    directory: Path, schedule: float, dense: float = 1.0, busy: float = 0.0, name: str = "", default: str = "schedule"
) -> tuple[Rung, int]:
    """The rung with a single plan of so many seconds a call, under another name too, and how many calls were made."""
    artifact = load_artifact(directory)
    plans = dict.fromkeys(filter(None, ("schedule", name)), artifact.manifest.plans["schedule"])
    artifact = replace(artifact, manifest=replace(artifact.manifest, plans=plans, default_plan=default))
    policy = Timed(ttscompile.load(directory, seed=0), {"dense": dense, "schedule": schedule, name: schedule}, busy)
    rung = check_engaged(artifact, load_golden(artifact), policy, lambda: policy.now)  # type: ignore[arg-type]
    return rung, policy.calls


def test_the_baseline_is_no_default(sound: Path) -> None:
    assert judged(sound, 0.25, name="uniform", default="schedule")[0].status == PASSED
    rung, _ = judged(sound, 0.25, name="uniform", default="uniform")
    assert rung.status == FAILED
    assert "plan 'uniform' is the default, and is the baseline of comparisons" in rung.told


@pytest.mark.parametrize("schedule", [1.0, 1.1, 0.96])
def test_a_plan_as_slow_as_a_dense_call_is_inert(sound: Path, schedule: float) -> None:
    rung, _ = judged(sound, schedule)
    assert rung.status == FAILED
    assert "saves no time" in rung.told
    assert f"{1 - schedule:.1%} saved" in rung.told


def test_so_is_one_on_a_machine_that_is_busy_now_and_then(sound: Path) -> None:
    """Rounds do not go on until the plan was once the faster."""
    assert judged(sound, 0.001, dense=0.001, busy=0.3)[0].status == FAILED


def test_where_other_programs_run_time_alone_is_no_fault(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = "other programs keep this machine busy (load 4.5 on 2 cores)"
    monkeypatch.setattr(reuse, "busy", lambda: f"{told}. Measure again.")
    rung, _ = judged(sound, 1.0)
    assert (rung.status, rung.remedy) == (SKIPPED, "Measure again.")
    assert "saves no time" in rung.told and rung.told.endswith(f"; but {told}")
    assert judged(sound, 1.0, name="uniform", default="uniform")[0].status == FAILED, "another fault"
    assert judged(sound, 0.25)[0].status == PASSED


def test_a_faster_plan_passes_and_every_figure_is_of_the_same_medians(sound: Path) -> None:
    rung, _ = judged(sound, 0.25)
    assert rung.status == PASSED
    found = rung.details["schedule"]
    assert (found["ms"], found["dense_ms"], found["time_saved"]) == pytest.approx((250, 1000, 0.75))
    assert "75% of the time (250 ms for 1000)" in rung.told


@pytest.mark.parametrize("busy", [0.1, 0.3, 0.5])
def test_other_work_does_not_make_a_fast_plan_inert(sound: Path, busy: float) -> None:
    assert judged(sound, 0.05, busy=busy)[0].status == PASSED


def test_a_plan_that_saves_much_less_than_its_flops_is_remarked_upon(sound: Path) -> None:
    rung, _ = judged(sound, 0.8)
    assert rung.status == PASSED
    assert rung.details["schedule"]["flops_saved"] > 0.4
    assert "less than half of what its FLOPs promise" in rung.told


@pytest.mark.parametrize(("dense", "rounds"), [(0.001, 15), (0.7, 4), (60.0, 3)])
def test_there_are_as_many_rounds_as_there_is_time_for_whatever_they_show(
    sound: Path, dense: float, rounds: int
) -> None:
    """A round makes three calls, two of them of the plan; one more warms up."""
    assert judged(sound, dense, dense)[1] == 3 * (rounds + 1)
