"""First-order predictions: exact where the policy is linear, and good enough to rank cells where it is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.calibration import tasks
from tests.calibration.tasks import MakeTask
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import PlanArray, Source, whole_steps_plan
from ttscompile.rivals import sensitivity
from ttscompile.rivals.sensitivity import LinearModel, linearise

CELLS = [(k, b) for k in range(1, 10) for b in range(6)]


def sparse_plan(seed: int = 0) -> PlanArray:
    draw = np.random.default_rng(seed)
    plan = np.where(draw.random((10, 6)) < 0.2, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
    plan[0] = Source.COMPUTE
    return plan


def terms_of_actions(task: Task, plan: PlanArray) -> int:
    """Terms of a run and of its derivative, which goes through every operation forwards, and back twice."""
    with Counted() as counted:
        task.executor.run(plan, task.calls)
    return 3 * counted.terms


def linearised(task: Task, plan: PlanArray) -> LinearModel:
    return linearise(task.executor, task.actions, plan, task.calls, seed=0)


def toggled(plan: PlanArray, k: int, b: int) -> PlanArray:
    other = plan.copy()
    other[k, b] = Source.TIMESTEP if plan[k, b] == Source.COMPUTE else Source.COMPUTE
    return other


def weighted_squares(task: Task, plans: list[PlanArray]) -> np.ndarray:
    """Squared error of each plan on each call, weighted as the model of the first plan weighs it."""
    executed = [task.actions.executed(task.executor.run(plan, task.calls)) for plan in plans]
    differences = torch.stack(executed) - task.actions.executed(task.calls.targets)
    sizes = differences[0].abs()
    return (differences**2 / (sizes + sensitivity.SOFTEN * sizes.median() + 1e-9)).sum(-1).numpy()


@pytest.fixture
def every_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many directions as the actions have, so that the projected error keeps all of the error."""
    monkeypatch.setattr(sensitivity, "DIRECTIONS", 8)


@pytest.mark.slow
@pytest.mark.usefixtures("every_direction")
def test_any_single_change_of_a_linear_policy_is_predicted_exactly(linear_policy: Path, recording: Path) -> None:
    task, plan = tasks.make_task(linear_policy, recording, calls=5), sparse_plan()
    model = linearised(task, plan)
    effects = model.toggles()
    expected = weighted_squares(task, [plan, *(toggled(plan, k, b) for k, b in CELLS)])[1:]
    found = ((model.error + np.stack([effects[k, b] for k, b in CELLS])) ** 2).reshape(len(CELLS), 5, 8).sum(-1)
    assert_equal_but_for_rounding(found, expected, terms_of_actions(task, plan))
    assert np.ptp(expected, axis=0).min() > 1  # else nothing was compared


@pytest.mark.usefixtures("every_direction")
def test_moving_a_computation_is_predicted_exactly_as_far_as_its_own_block(
    linear_policy: Path, recording: Path
) -> None:
    """The computed value is that of the rollout that was linearised, as nothing before it changes."""
    task, plan = tasks.make_task(linear_policy, recording, calls=3), whole_steps_plan(10, 6, [0])
    moved = toggled(plan, 6, 2)
    one, other = (task.actions.executed(task.executor.run(each, task.calls)) for each in (moved, plan))
    assert float((one - other).abs().max()) > 0.01  # else nothing was compared
    model = linearised(task, plan)
    predicted = ((model.error + model.toggles()[6, 2]) ** 2).reshape(3, -1).sum(-1)
    expected = weighted_squares(task, [plan, moved])[1]
    assert_equal_but_for_rounding(predicted, expected, terms_of_actions(task, plan))


@pytest.mark.slow
@pytest.mark.usefixtures("every_direction")
def test_cells_of_a_nonlinear_policy_are_ranked(make_task: MakeTask) -> None:
    task, plan = make_task(calls=12), sparse_plan(2)
    model = linearised(task, plan)
    predicted = ((model.error + model.toggles()) ** 2).sum(-1)[1:].flatten()
    measured = weighted_squares(task, [plan, *(toggled(plan, k, b) for k, b in CELLS)]).sum(1)[1:]
    ranks = np.argsort(np.argsort(np.stack([predicted, measured]), axis=1), axis=1)
    assert np.corrcoef(ranks)[0, 1] > 0.8


def test_calls_are_linearised_alike_however_many_at_once(make_task: MakeTask, monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_task(calls=5)
    together = linearised(task, sparse_plan())
    monkeypatch.setattr(sensitivity, "BYTES", 1)
    apart = linearised(task, sparse_plan())
    assert_equal_but_for_rounding(apart.reach, together.reach, terms_of_actions(task, sparse_plan()))
    np.testing.assert_array_equal(apart.error, together.error)


def test_each_residual_is_added_from_its_computation_to_the_next() -> None:
    """By hand: K = 4, one block; what is computed at o contributes 10 o + k at each step k >= o."""
    reach = np.zeros((1, 5, 4, 1), np.float32)
    for k in range(4):
        reach[0, k + 1, :, 0] = reach[0, k, :, 0] + 10 * np.arange(4) + k
    computed = np.array([[True], [False], [True], [False]])
    model = LinearModel(reach, np.array([100.0], np.float32), computed)
    toggles = model.toggles()[:, 0, 0]
    np.testing.assert_array_equal(toggles, [0, 10, -40, 10])  # 1: 11 for 1; 2: 2+3 for 22+23; 3: 33 for 23
    other = LinearModel(reach, model.error, np.array([[True], [True], [False], [False]]))
    assert other.toggles()[1, 0, 0] == 6 - (11 + 12 + 13)
