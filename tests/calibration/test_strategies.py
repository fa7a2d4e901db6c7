"""What holds for every strategy: plans are legal and within the budget, and an interruption changes nothing."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from ttscompile.calibration.pruner import paper
from ttscompile.calibration.schedule import open_search, search_plan
from ttscompile.calibration.strategies import CORRECTING, DEFAULT, NAMES, STRATEGIES, strategy_of
from ttscompile.calibration.strategy import Strategy
from ttscompile.calibration.task import Found, Task
from ttscompile.core.lattice import Source, illegal_cells
from ttscompile.errors import CalibrationError
from ttscompile.rivals import evo, gates, online

from .tasks import MakeTask, found_by

BUDGET = 34
"""Of 10 x 6 cells: enough for all strategies."""


@pytest.fixture(autouse=True, scope="module")
def short_searches() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gates.Gates, "intervals", 4)
        patch.setattr(evo.Evo, "intervals", 4)
        patch.setattr(paper.Paper, "intervals", 4)
        patch.setattr(evo, "POPULATION", 16)
        patch.setattr(online, "HALVINGS", 5)
        yield


@pytest.fixture(scope="module")
def whole(make_task: MakeTask) -> Callable[[str, int], tuple[Found, Task]]:
    """What a search that nothing interrupts finds within a budget, and for which task; each is made once."""

    @cache
    def found(name: str, budget: int) -> tuple[Found, Task]:
        task = make_task(budget, calls=8)
        return found_by(name, task), task

    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "budget"),
    [*((name, BUDGET) for name in NAMES), ("bac", 59), ("delta-dit", 59), ("deepcache", 59), ("sag", 7)],
)
def test_a_plan_is_legal_and_within_the_budget(
    whole: Callable[[str, int], tuple[Found, Task]], name: str, budget: int
) -> None:
    found, task = whole(name, budget)
    model = task.runner.model
    assert found.schedule.shape == (model.steps, model.blocks)
    assert found.schedule.dtype == np.int8
    assert not illegal_cells(found.schedule, model.groups, np.zeros(found.schedule.shape, np.bool_)).any()
    computed = int((found.schedule == Source.COMPUTE).sum())
    assert budget - model.blocks < computed <= budget  # and hardly less: no strategy leaves a whole step unused


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(NAMES) - {"interval"}))
def test_going_on_from_a_state_ends_where_another_run_ends(
    make_task: MakeTask, whole: Callable[[str, int], tuple[Found, Task]], name: str
) -> None:
    expected, task = whole(name, BUDGET)[0], make_task(BUDGET, calls=8)
    stopped = open_search(name, task)
    stopped.advance(0)
    if not stopped.done:
        stopped.advance(1)
    state = stopped.state()
    resumed = open_search(name, task)
    resumed.restore({key: value.copy() for key, value in state.items()})
    assert resumed.done == stopped.done
    np.testing.assert_array_equal(resumed.plan, stopped.plan)
    found = search_plan(resumed, task.clock, first=2)[0]
    np.testing.assert_array_equal(found.schedule, expected.schedule)
    assert found.notes == expected.notes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evo", "dip-go", "tts"])
def test_a_search_beats_even_steps(make_task: MakeTask, name: str) -> None:
    task = make_task(20, calls=24)
    even, searched = (task.error(found_by(one, task).schedule, task.calls) for one in ("interval", name))
    assert searched < even


LEAST = {"deepcache": 24, "delta-dit": 15, "l2c": 30, "teacache": 12, "dbcache": 15}
"""Cells of 10 x 6 that a strategy cannot do without; step 0 for the others."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [(name, LEAST.get(name, 6)) for name in NAMES])
def test_a_budget_out_of_reach_is_refused_and_the_next_cell_is_not(make_task: MakeTask, name: str, least: int) -> None:
    sparsity = f"{1 - least / 60:.4g}"
    with pytest.raises(CalibrationError, match=rf"'{name}' computes at least {least} of the 10 x 6 .* of {sparsity};"):
        open_search(name, make_task(least - 1))
    with pytest.raises(CalibrationError, match=f"leaves {least - 1}"):
        strategy_of(name).require_reach(10, 6, least - 1)
    found = found_by(name, make_task(least))
    assert int((found.schedule == Source.COMPUTE).sum()) == least


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_call_is_enough(make_task: MakeTask, name: str) -> None:
    found = found_by(name, make_task(BUDGET, calls=1))
    assert int((found.schedule == Source.COMPUTE).sum()) <= BUDGET


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(CalibrationError, match="'magic'; expected one of tts, tts-paper, interval"):
        strategy_of("magic")


def test_fewer_intervals_than_a_strategy_has(make_task: MakeTask) -> None:
    task = make_task(BUDGET)
    assert found_by("evo", task, 2).notes == {"generations": 2}
    assert found_by("evo", task, 1000).notes == {"generations": 4}


def test_names_are_given_once_and_the_first_is_the_default() -> None:
    """Each with a maker, and with what it is from."""
    assert len(set(NAMES)) == len(STRATEGIES)
    assert all(one.make().__doc__ and one.source for one in STRATEGIES)
    assert (DEFAULT, CORRECTING) == ("tts", ("tts",))
    assert [one.name for one in STRATEGIES if one.baseline] == ["interval"]


def test_a_name_without_a_maker_is_an_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        Strategy("magic", "none", "rivals.bac:magic").make()
    with pytest.raises(ModuleNotFoundError, match="magic"):
        Strategy("magic", "none", "rivals.magic:magic").make()


def test_the_table_is_read_without_torch() -> None:
    code = "import sys, ttscompile.calibration.strategies; print(sorted({'numpy', 'torch'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_nobody_asks_for_a_strategy_by_its_name() -> None:
    """What depends on a strategy is a property of its record."""
    asked = re.compile(rf"""(==|!=|\bin|\bcase) \(?["'](?:{"|".join(map(re.escape, NAMES))})["']""")
    package = Path(ttscompile.__file__).parent
    found = [
        f"{path.relative_to(package)}:{number}: {line.strip()}"
        for path in package.rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if asked.search(line)
    ]
    assert found == []
    assert asked.search('if strategy == "tts":')
    assert asked.search('if strategy in ("sag", "l2c"):')
