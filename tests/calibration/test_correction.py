"""Corrections that are fitted: exact where the policy is linear, better on calls that they were not fitted on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import regression
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.sparse_loop import anchors_of, fit_correction
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.whole_steps import FITTED_SHARE, SMALL_SHARE, Errors, WholeSteps, _set_apart, _sizes
from ttscompile.core.lattice import PlanArray, Source, dense_plan, uniform_plan
from ttscompile.errors import CalibrationError

from . import tasks
from .tasks import MakeTask

pytestmark = pytest.mark.usefixtures("long_training")


@pytest.fixture
def plan(compiled: Path) -> PlanArray:
    manifest = load_artifact(compiled).manifest
    return uniform_plan(manifest.steps, len(manifest.blocks), 3)


def test_anchors_are_steps_that_compute_half_their_blocks() -> None:
    plan = np.full((4, 4), Source.TIMESTEP, np.int8)
    plan[0] = plan[2, :2] = plan[3, 0] = Source.COMPUTE
    assert anchors_of(plan).tolist() == [True, False, True, False]


def fitted(task: Task, plan: PlanArray, reads: bool = True) -> Task:
    """The same with the correction of a plan, fitted on all of its calls."""
    return replace(task, runner=task.runner.corrected(fit_correction(task.runner, plan, task.calls, reads)))


@pytest.mark.slow
def test_it_helps_on_calls_of_other_episodes(make_task: MakeTask, plan: PlanArray) -> None:
    task, held_out = make_task(calls=400, episodes=range(4)), make_task(calls=60, episodes=range(4, 6)).calls
    corrected = fitted(task, plan)
    assert task.runner.correction is None
    assert corrected.error(plan, held_out) < 0.5 * task.error(plan, held_out)


@pytest.mark.slow
def test_a_linear_policy_is_corrected_to_its_own_noise(
    linear_policy: Path, recording: Path, plan: PlanArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything between anchors is linear in the features, but for how the observation enters: nearly exact."""
    monkeypatch.setattr(regression, "RIDGE", 1e-9)
    task = tasks.make_task(linear_policy, recording, calls=300)
    assert fitted(task, plan).error(plan, task.calls) < 0.05 * task.error(plan, task.calls)


def test_a_dense_plan_needs_none(make_task: MakeTask) -> None:
    task = make_task(calls=80)
    dense = dense_plan(task.runner.model.steps, task.runner.model.blocks)
    corrected = fitted(task, dense)
    assert corrected.runner.correction is not None
    assert np.abs(corrected.runner.correction.weights).max() < 1e-3
    assert corrected.error(dense, task.calls) < 1e-5


@pytest.mark.slow
def test_the_reference_runtime_does_the_same(make_task: MakeTask, plan: PlanArray) -> None:
    task = make_task(calls=70)
    runner, calls = fitted(task, plan).runner, task.calls
    ours = runner.run(plan, calls)
    with torch.no_grad(), Counted() as counted:
        theirs = runner.model.denoise(calls.contexts, calls.initial, calls.noise, plan, correction=runner.correction)
    assert_equal_but_for_rounding(ours, theirs.sample, counted.terms)


@pytest.mark.slow
def test_it_reads_the_observation_where_that_helps_on_other_episodes(make_task: MakeTask, plan: PlanArray) -> None:
    task = make_task(calls=400, episodes=range(4))
    held_out = make_task(calls=60, episodes=range(4, 6)).calls
    steps = task.runner.model.steps
    early, late = (task.whole.plan([0, k]) for k in (steps // 2, steps - 2))
    blind, reading = (
        min(fitted(task, two, reads).error(two, held_out) for two in (early, late)) for reads in (False, True)
    )
    assert task.whole.reads(2) == (reading < blind)
    correction = task.whole.correction_of(task.whole.plan([0, steps - 2]))
    assert correction is not None
    assert (correction.reads > 0) == task.whole.reads(2)


@pytest.mark.slow
def test_any_schedule_can_be_corrected(make_task: MakeTask, plan: PlanArray) -> None:
    """Also one that computes single blocks, of a rival that fits no correction itself."""
    task, held_out = make_task(calls=400, episodes=range(4)), make_task(calls=60, episodes=range(4, 6)).calls
    single = plan.copy()
    single[1, :2] = Source.COMPUTE
    for schedule in (plan, single):
        found = task.corrected(Found(schedule, {"made": "by hand"}))
        assert found.correction is not None
        assert found.notes["corrected"] is True and found.notes["made"] == "by hand"
        better = replace(task, runner=task.runner.corrected(found.correction))
        assert better.error(schedule, held_out) < 0.5 * task.error(schedule, held_out)


@pytest.mark.slow
def test_a_loop_that_ends_in_no_numbers_gets_no_correction(make_task: MakeTask, plan: PlanArray) -> None:
    task = make_task(calls=40)
    assert task.calls.path is not None
    calls = replace(task.calls, path=task.calls.path * float("nan"))
    assert WholeSteps(task.runner, calls, 0).correction_of(plan) is None


def test_a_plan_that_reads_earlier_calls_is_not_corrected(make_task: MakeTask, plan: PlanArray) -> None:
    rollout = plan.copy()
    rollout[1, 0] = Source.ROLLOUT
    with pytest.raises(CalibrationError, match="reads residuals of earlier calls.* Leave correct out"):
        make_task(calls=20).corrected(Found(rollout))


def test_calls_of_one_episode_do_not_tell_whether_reading_helps(make_task: MakeTask) -> None:
    assert make_task(calls=60, episodes=range(1)).whole.reads(2) is False


def test_a_small_network_is_asked_on_every_quarter_of_the_episodes(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, errors, asked = make_task(calls=80, episodes=range(4)), WholeSteps._errors_of, list[frozenset[int]]()

    def told(self: WholeSteps, samples: torch.Tensor, of: Calls) -> Errors:
        asked.append(frozenset(of.episodes.tolist()))
        return errors(self, samples, of)

    monkeypatch.setattr(WholeSteps, "_errors_of", told)
    for small, parts in ((False, 1), (True, 4)):
        asked.clear()
        WholeSteps(task.runner, task.calls, 0, small=small).reads(2)
        assert len(set(asked)) == parts
    assert sorted(episode for quarter in set(asked) for episode in quarter) == list(range(4))


def test_where_there_are_many_calls_candidates_see_more_of_them() -> None:
    assert _sizes(100, FITTED_SHARE) == _sizes(3072, FITTED_SHARE) == _sizes(1536, SMALL_SHARE) == (384, 128)
    assert _sizes(12_288, FITTED_SHARE) == (1536, 512)
    assert _sizes(2595, SMALL_SHARE) == (648, 216)


def test_schedules_are_compared_on_other_episodes_than_they_were_fitted_on() -> None:
    episodes = np.array([3, 1, 1, 0, 3, 2, 0, 4])
    assert _set_apart(episodes).tolist() == (episodes == 3).tolist()
    assert _set_apart(episodes, 2).tolist() == (episodes == 0).tolist()
    assert _set_apart(np.array([5, 5, 5, 5])).tolist() == [True, False, False, False]
    assert _set_apart(np.array([5])).tolist() == [True]


@pytest.mark.parametrize("groups", [1, 3])
def test_the_regression_finds_what_made_the_numbers(monkeypatch: pytest.MonkeyPatch, groups: int) -> None:
    monkeypatch.setattr(regression, "RIDGE", 1e-12)
    draw = torch.Generator().manual_seed(0)
    read, seen, weight, observed, bias = (
        torch.randn(*shape, generator=draw, dtype=torch.float64)
        for shape in ((3, 200, 12), (200, 5), (groups, 12, 2), (3, 5, 2), (3, 1, 2))
    )
    seen = seen - seen.mean(0)
    missing = read @ weight + seen @ observed + bias
    found = regression.solve(read, seen, missing, groups)
    for ours, made in ((found.weight, weight), (found.observed, observed.transpose(0, 1)), (found.bias, bias)):
        torch.testing.assert_close(ours, made.float(), rtol=0, atol=1e-4)
