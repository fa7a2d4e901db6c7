"""The slopes of all gates are those that automatic differentiation finds for one formula of all cells."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.calibration.tasks import MakeTask
from tests.rounding import Counted, assert_equal_but_for_rounding
from tests.runtimes.recorded import everything_recorded
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.rivals import slopes as module
from ttscompile.rivals.slopes import chains, slopes


def random_plan(reuse: Source, computed: float) -> PlanArray:
    draw = np.random.default_rng(1)
    plan = np.where(draw.random((10, 6)) < computed, Source.COMPUTE, reuse).astype(np.int8)
    plan[0] = Source.COMPUTE
    return plan


def gradients(task: Task, plan: PlanArray, reuse: Source) -> np.ndarray:
    """Straight through the gates of one formula of all cells."""
    calls = task.calls
    one_hot = torch.nn.functional.one_hot(torch.from_numpy(plan.astype(np.int64)), 4).float()
    gates = one_hot.repeat(calls.count, 1, 1, 1).requires_grad_()
    sample = everything_recorded(task.runner.model, calls.contexts, calls.initial, calls.noise, gates, {})
    executed, expected = task.actions.executed(sample), task.actions.executed(calls.targets)
    (executed - expected).abs().mean().backward()
    assert gates.grad is not None
    slope = gates.grad[..., Source.COMPUTE] - gates.grad[..., reuse]
    return np.asarray(slope.sum(0).numpy())


@pytest.mark.slow
@pytest.mark.parametrize("reuse", [Source.FORWARD, Source.TIMESTEP])
@pytest.mark.parametrize("computed", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("size", [1, 2**28])
def test_slopes_are_the_gradients_of_a_whole_formula(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch, reuse: Source, computed: float, size: int
) -> None:
    monkeypatch.setattr(module, "BYTES", size)  # one call at a time, or all
    task = make_task(20, calls=5)
    plan = random_plan(reuse, computed)
    found = slopes(task.runner, task.actions, plan, reuse, task.calls)
    with Counted() as counted:
        expected = gradients(task, plan, reuse)
    assert np.abs(expected[1:]).max() > 1e-3
    assert_equal_but_for_rounding(found[1:], expected[1:], counted.terms)
    np.testing.assert_array_equal(found[0], 0)


def test_chains() -> None:
    plan = np.zeros((2, 3), np.int8)
    assert [chain.tolist() for chain in chains(plan, Source.TIMESTEP, (0, 1, 0))] == [[0, 3], [1, 4], [2, 5]]
    assert [chain.tolist() for chain in chains(plan, Source.FORWARD, (0, 1, 0))] == [[0, 2, 3, 5], [1, 4]]
