"""What holds for every strategy: plans are legal and within the budget, and an interruption changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from ttscompile.calibration import strategies
from ttscompile.calibration.strategies import (
    NAMES,
    Found,
    Strategy,
    evo,
    gates,
    online,
    open_strategy,
    plan_of,
    require_reach,
)
from ttscompile.core.lattice import Source, illegal_cells
from ttscompile.errors import CalibrationError

from ..tasks import MakeTask

BUDGET = 34
"""Of 10 x 6 cells: enough for all strategies."""


@pytest.fixture(autouse=True)
def short_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gates.Gates, "intervals", 4)
    monkeypatch.setattr(evo.Evo, "intervals", 4)
    monkeypatch.setattr(evo, "POPULATION", 16)
    monkeypatch.setattr(online, "HALVINGS", 5)


def run(strategy: Strategy, first: int = 0) -> Found:
    for interval in range(first, strategy.intervals):
        if strategy.done:
            break
        strategy.advance(interval)
    return strategy.found()


@pytest.mark.parametrize(
    ("name", "budget"),
    [*((name, BUDGET) for name in NAMES), ("bac", 59), ("delta-dit", 59), ("deepcache", 59), ("sag", 7)],
)
def test_a_plan_is_legal_and_within_the_budget(make_task: MakeTask, name: str, budget: int) -> None:
    task = make_task(budget, calls=8)
    found, _ = plan_of(name, task)
    model = task.executor.model
    assert found.schedule.shape == (model.steps, model.blocks)
    assert found.schedule.dtype == np.int8
    assert not illegal_cells(found.schedule, model.groups, np.zeros(found.schedule.shape, np.bool_)).any()
    computed = int((found.schedule == Source.COMPUTE).sum())
    assert budget - model.blocks < computed <= budget  # and hardly less: no strategy leaves a whole step unused


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"interval"}))
def test_going_on_from_a_state_ends_where_another_run_ends(make_task: MakeTask, name: str) -> None:
    whole = run(open_strategy(name, make_task(BUDGET, calls=8)))
    task = make_task(BUDGET, calls=8)
    stopped = open_strategy(name, task)
    stopped.advance(0)
    if not stopped.done:
        stopped.advance(1)
    state = stopped.state()
    resumed = open_strategy(name, task)
    resumed.restore({key: value.copy() for key, value in state.items()})
    assert resumed.done == stopped.done
    np.testing.assert_array_equal(resumed.plan, stopped.plan)
    found = run(resumed, first=2)
    np.testing.assert_array_equal(found.schedule, whole.schedule)
    assert found.notes == whole.notes
    assert found.criterion == whole.criterion


@pytest.mark.parametrize("name", ["evo", "dip-go", "tts"])
def test_a_search_beats_even_steps(make_task: MakeTask, name: str) -> None:
    task = make_task(20, calls=24)
    even, searched = (task.error(plan_of(one, task)[0].schedule, task.calls) for one in ("interval", name))
    assert searched < even


LEAST = {"deepcache": 24, "delta-dit": 15, "l2c": 30, "teacache": 12, "dbcache": 15}
"""Cells of 10 x 6 that a strategy cannot do without; step 0 for the others."""


@pytest.mark.parametrize(("name", "least"), [(name, LEAST.get(name, 6)) for name in NAMES])
def test_a_budget_out_of_reach_is_refused_and_the_next_cell_is_not(make_task: MakeTask, name: str, least: int) -> None:
    sparsity = f"{1 - least / 60:.4g}"
    with pytest.raises(CalibrationError, match=rf"'{name}' computes at least {least} of the 10 x 6 .* of {sparsity};"):
        open_strategy(name, make_task(least - 1))
    with pytest.raises(CalibrationError, match=f"leaves {least - 1}"):
        require_reach(name, 10, 6, least - 1)
    found, _ = plan_of(name, make_task(least))
    assert int((found.schedule == Source.COMPUTE).sum()) == least


@pytest.mark.parametrize("name", NAMES)
def test_one_call_is_enough(make_task: MakeTask, name: str) -> None:
    found, _ = plan_of(name, make_task(BUDGET, calls=1))
    assert int((found.schedule == Source.COMPUTE).sum()) <= BUDGET


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(CalibrationError, match="'magic'; expected one of tts, interval, bac"):
        require_reach("magic", 10, 6, 60)


def test_fewer_intervals_than_a_strategy_has(make_task: MakeTask) -> None:
    task = make_task(BUDGET)
    assert plan_of("evo", task, 2)[0].notes == {"generations": 2}
    assert plan_of("evo", task, 1000)[0].notes == {"generations": 4}


def test_every_strategy_is_described() -> None:
    assert strategies.__doc__ is not None
    assert all(f"``{name}``" in strategies.__doc__ for name in NAMES)
