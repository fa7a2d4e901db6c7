"""The training of the paper: its head keeps the budget, goes on where it stopped, and is executed as it was trained."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration.policies import record
from tests.calibration.tasks import MakeTask, in_windows
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import judge, schedule
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import Score
from ttscompile.calibration.kept import Kept, holding
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.pruner import paper
from ttscompile.calibration.pruner.paper import Paper
from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import Source, whole_steps_plan
from ttscompile.ir.plan_head import NAMES
from ttscompile.runtimes.plans import pruner_plan

BUDGET = 20


def trained(task: Task, updates: int, **options: object) -> Paper:
    search = Paper(task, **options)  # type: ignore[arg-type]
    for interval in range(updates):
        search.advance(interval)
    return search


@pytest.fixture
def task(make_task: MakeTask, monkeypatch: pytest.MonkeyPatch) -> Task:
    monkeypatch.setattr(Paper, "intervals", 40)
    task = make_task(BUDGET, calls=2)
    return replace(task, calls=in_windows(task, 12))


@pytest.mark.slow
def test_training_lowers_the_error_and_keeps_the_budget(task: Task) -> None:
    search = trained(task, 1, begin=[0, 1, 2])
    before, after = search.loss, trained(task, 20, begin=[0, 1, 2])
    found = after.found()
    assert after.loss < before
    assert found.notes["computed_cells"]["mean"] <= BUDGET
    assert found.notes["computed_cells"]["most"] >= found.notes["computed_cells"]["mean"]
    assert (found.schedule == Source.COMPUTE).sum() == BUDGET
    assert found.pruner is not None
    made = pruner_plan(task.runner.logits(task.calls, found.pruner))
    assert (made[:, 0] == Source.COMPUTE).all()
    for name in NAMES - {paper.BASE}:
        assert not np.array_equal(found.pruner[name], task.pruner[name]), name


@pytest.mark.parametrize("windows", [2, 3, 8])
def test_windows_of_one_episode_are_divided(make_task: MakeTask, windows: int) -> None:
    task = make_task(BUDGET, calls=2 * windows, episodes=range(1))
    practised, compared = paper._divided(replace(task, calls=replace(task.calls, window=2)))
    assert sorted([*practised, *compared]) == list(range(2 * windows))


@pytest.mark.slow
def test_nothing_is_kept_that_is_worse_than_whole_steps(task: Task) -> None:
    search = trained(task, 1)
    family = spacings(10, 3)
    best = min(task.error(whole_steps_plan(10, 6, steps), search._compared) for steps in family)
    assert search.loss <= best * (1 + 1e-5)
    assert trained(task, 11).loss <= search.loss


def test_a_call_may_compute_more_than_others_within_the_mean() -> None:
    """Of ten calls only the first wants to compute, and more and more towards the end; nine cells a call are left."""
    logits = np.zeros((10, 10, 6, 4), np.float32)
    logits[0, 1:, :, Source.COMPUTE] = np.arange(1, 55).reshape(9, 6)
    price = paper._price(logits, 6 + 3)
    assert price == 24.5
    logits[..., Source.COMPUTE] -= price
    computed = (pruner_plan(logits)[:, 1:] == Source.COMPUTE).sum((1, 2))
    assert computed.tolist() == [30, *[0] * 9]


@pytest.mark.parametrize("source", [Source.FORWARD, Source.TIMESTEP, Source.ROLLOUT])
def test_a_direction_alone(task: Task, source: Source) -> None:
    found = trained(task, 3, sources=[source]).found()
    allowed = {Source.COMPUTE.name, Source.TIMESTEP.name, source.name}
    assert {name for name, count in found.notes["sources"].items() if count} <= allowed


def test_a_plan_for_all_calls(task: Task) -> None:
    found = trained(task, 3, observes=False).found()
    assert found.pruner is None
    assert found.notes["computed_cells"]["mean"] == found.notes["computed_cells"]["most"] == BUDGET


def test_nothing_is_read_of_earlier_calls_where_calls_stand_alone(make_task: MakeTask) -> None:
    found = trained(make_task(BUDGET, calls=8), 2).found()
    assert found.pruner is not None
    assert (found.pruner[paper.BASE][..., Source.ROLLOUT] == paper.FORBIDDEN).all()
    assert found.notes["sources"]["ROLLOUT"] == 0


def test_an_earlier_calibration_leaves_no_trace(task: Task) -> None:
    """The head of the artifact is the one that it left."""
    left = {name: value if name == "pruner.mask" else np.zeros_like(value) for name, value in task.pruner.items()}
    first, again = trained(task, 2).state(), trained(replace(task, pruner=left), 2).state()
    for name, value in first.items():
        np.testing.assert_array_equal(again[name], value, err_msg=name)


def test_nothing_is_tried_before_the_first_update(task: Task) -> None:
    """So one that was interrupted after its last update is not cut short by a limit that is over when it goes on."""
    clock = Clock(0.0)
    search = Paper(replace(task, clock=clock))
    search.restore(trained(task, 1).state())
    assert not clock.left_out


@pytest.mark.slow
def test_going_on_equals_not_stopping(task: Task) -> None:
    whole, stopped = trained(task, 12), trained(task, 5)
    resumed = Paper(task)
    resumed.restore({name: value.copy() for name, value in stopped.state().items()})
    for interval in range(5, 12):
        resumed.advance(interval)
    for name, value in whole.state().items():
        np.testing.assert_array_equal(resumed.state()[name], value, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("correct", [False, True])
def test_an_artifact_executes_it(
    compiled: Path, tmp_path: Path, correct: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This is about what is executed: no head learns in so few updates, so every one is kept."""
    monkeypatch.setattr(Paper, "intervals", 8)
    monkeypatch.setattr(schedule, "BETTER", 10.0)
    monkeypatch.setattr(schedule, "learned_nothing", lambda score, intervals: None)
    monkeypatch.setattr(Kept, "_no_better", lambda *_: None)
    directory = Path(shutil.copytree(compiled, tmp_path / "compiled"))
    recording = record(tmp_path / "calls.npz", episodes=24)
    result = ttscompile.calibrate(
        directory, [recording], 0.6, learn=("tts-paper",), correct=correct, progress=False, max_minutes=1
    )
    assert result.plans["pruner"].sparsity >= 0.6 - 1e-9
    artifact = load_artifact(directory)
    assert (artifact.manifest.calibration or {})["computed_cells"]["mean"] <= 24
    policy = ttscompile.load(directory, plan="pruner")
    draw = np.random.default_rng(0)
    for call in range(4):
        policy.predict_action({"obs": draw.standard_normal((1, 2, 3)).astype(np.float32)})
        report = policy.last_report
        assert report is not None
        assert report.plan_name == "pruner"
        assert call or not (report.plan == Source.ROLLOUT).any()  # nothing can be read in the first call


def test_a_head_that_has_learned_nothing_says_so_and_is_no_default(
    compiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One update, as on a busy machine: the head makes one plan for all observations, which is the schedule's."""
    directory = Path(shutil.copytree(compiled, tmp_path / "compiled"))
    recording, before = record(tmp_path / "calls.npz", episodes=8), load_artifact(compiled).pruner
    result = ttscompile.calibrate(directory, [recording], 0.6, learn=("tts-paper",), max_intervals=1)
    assert result.default_plan == "schedule"
    assert "has learned nothing in 1 update" in result.skipped["pruner"]
    assert "'pruner' is left out: it has learned nothing in 1 update" in capsys.readouterr().err
    artifact = load_artifact(directory)
    assert artifact.manifest.default_plan == "schedule"
    assert "pruner" not in artifact.plans
    for name, array in before.items():
        np.testing.assert_array_equal(artifact.pruner[name], array)


@pytest.mark.slow
def test_a_head_is_kept_if_it_is_nearer_than_the_schedule_and_its_plans_differ(
    compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Learned after the schedule, from which it departs; judged as any other plan."""
    directory = Path(shutil.copytree(compiled, tmp_path / "compiled"))
    recording, considered = record(tmp_path / "calls.npz", episodes=8), list[tuple[str, bool, Score]]()
    consider = Kept.consider

    def seen(self: Kept, proposal: Proposal) -> str | None:
        score = judge.judge(holding(self.trials, proposal), proposal.plan)
        refusal = consider(self, proposal)
        considered.append((proposal.name, refusal is None, score))
        return refusal

    monkeypatch.setattr(Kept, "consider", seen)
    result = ttscompile.calibrate(
        directory, [recording], 0.6, learn=("schedule", "pruner"), max_intervals=10, progress=False
    )
    scores = {name: (kept, score) for name, kept, score in considered}
    (kept, head), (_, fixed) = scores["pruner"], scores["schedule"]
    better = head.plans > 1 and head.sparsity >= fixed.sparsity - 1e-9 and head.distance < fixed.distance
    assert kept == better
    assert (result.default_plan == "pruner") == better
    assert ("pruner" in load_artifact(directory).plans) == better
    assert "updates" in result.told["pruner"]
