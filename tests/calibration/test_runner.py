"""The runner of many plans means what the reference runtime means."""

import numpy as np
import pytest
import torch

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.calibration import calls, runner as runner_module
from ttscompile.core.lattice import Source, dense_plan
from ttscompile.errors import IllegalPlanError

from .tasks import MakeTask


def random_plans(count: int, computed: float) -> np.ndarray:
    rest = (1 - computed) / 2
    plans = np.random.default_rng(3).choice(3, (count, 10, 6), p=[computed, rest, rest]).astype(np.int8)
    plans[:, 0] = Source.COMPUTE
    return plans


@pytest.mark.slow
@pytest.mark.parametrize("computed", [0.05, 0.5])
def test_plans_on_calls_equal_the_reference(make_task: MakeTask, computed: float) -> None:
    task = make_task(calls=3)
    runner, calls = task.runner, task.calls
    plans = random_plans(12, computed)
    plans[1, 1:] = Source.TIMESTEP  # nothing computed after step 0
    for plan in plans:
        with Counted() as counted:
            expected = runner.model.denoise(calls.contexts, calls.initial, calls.noise, plan).sample
        assert_equal_but_for_rounding(runner.run(plan, calls), expected, counted.terms)


def test_observations_may_go_through_the_prologue_a_few_at_a_time(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the loop reads is then that of one batch, in the order of the calls."""
    whole = make_task(calls=7).calls
    monkeypatch.setattr(calls, "OBSERVED_AT_ONCE", 3)
    found = make_task(calls=7).calls
    assert found.contexts.streams == 7
    mine, theirs = found.contexts.condition, whole.contexts.condition
    assert mine.keys() == theirs.keys()
    for name, value in mine.items():
        assert value.shape == theirs[name].shape
        np.testing.assert_allclose(value, theirs[name], rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("streams", [1, 2, 256])
def test_a_plan_for_each_call_equals_the_reference(
    make_task: MakeTask, streams: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner_module, "STREAMS", streams)
    task, plans = make_task(calls=5), random_plans(5, 0.3)
    runner, calls = task.runner, task.calls
    with Counted() as counted:
        expected = runner.model.denoise(calls.contexts, calls.initial, calls.noise, plans).sample
    assert_equal_but_for_rounding(runner.run(plans, calls), expected, counted.terms)


def test_different_plans_have_different_results(make_task: MakeTask) -> None:
    """Else the tests above would compare constants."""
    task = make_task(calls=3)
    first, second = (task.runner.run(plan, task.calls) for plan in random_plans(2, 0.3))
    assert (first - second).abs().max() > 1e-3
    assert (first[0] - first[1]).abs().max() > 1e-3


def test_calls_are_selected_in_the_order_given(make_task: MakeTask) -> None:
    task = make_task(calls=4)
    with Counted() as counted:
        some = task.runner.run_dense(task.runner.select(task.calls, [2, 0, 2]))
    assert task.calls.path is not None
    assert_equal_but_for_rounding(some, task.calls.path[[2, 0, 2]], counted.terms)


def test_of_consecutive_calls_nothing_is_copied_that_the_prologue_gave(make_task: MakeTask) -> None:
    task = make_task(calls=4)
    views, copies = (task.runner.select(task.calls, [1, 2], consecutive=one).contexts for one in (True, False))
    given = task.calls.contexts
    each = (views.condition, copies.condition, given.condition)
    memory = [[one[name].untyped_storage().data_ptr() for one in each] for name in each[0]]
    assert memory and all(own == whole for own, _, whole in memory)
    assert any(copied != whole for _, copied, whole in memory)
    assert all(torch.equal(view, copies.condition[name]) for name, view in views.condition.items())


def test_a_plan_that_needs_an_earlier_call_is_refused(make_task: MakeTask) -> None:
    task, plan = make_task(calls=2), dense_plan(10, 6)
    plan[3, 1] = Source.ROLLOUT
    with pytest.raises(IllegalPlanError, match="earlier call"):
        task.runner.run(plan, task.calls)
    with pytest.raises(IllegalPlanError, match="dense step 0"):
        task.runner.run(np.full_like(plan, Source.TIMESTEP), task.calls)
