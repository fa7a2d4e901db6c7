"""What holds for each proposer of schedules: plans are legal and within the budget; interruptions change nothing."""

import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from ttscompile.calibration.proposer import ScheduleRow
from ttscompile.calibration.proposers import PROPOSERS, RIVALS, SCHEDULES, rows_of
from ttscompile.calibration.pruner import paper
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.task import Found, Task
from ttscompile.core.lattice import Source, illegal_cells
from ttscompile.errors import CalibrationError
from ttscompile.rivals import evo, gates, online

from .tasks import MakeTask, found_by, row_of

NAMES = [row.name for row in SCHEDULES]

BUDGET = 34
"""Of 10 x 6 cells: enough for all searches."""


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
    assert budget - model.blocks < computed <= budget  # and hardly less: no search leaves a whole step unused


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(NAMES) - {"interval"}))
def test_going_on_from_a_state_ends_where_another_run_ends(
    make_task: MakeTask, whole: Callable[[str, int], tuple[Found, Task]], name: str
) -> None:
    expected, task = whole(name, BUDGET)[0], make_task(BUDGET, calls=8)
    stopped = row_of(name).search(task)
    stopped.advance(0)
    if not stopped.done:
        stopped.advance(1)
    state = stopped.state()
    resumed = row_of(name).search(task)
    resumed.restore({key: value.copy() for key, value in state.items()})
    assert resumed.done == stopped.done
    np.testing.assert_array_equal(resumed.plan, stopped.plan)
    found = search_plan(resumed, task.clock, first=2)[0]
    np.testing.assert_array_equal(found.schedule, expected.schedule)
    assert found.notes == expected.notes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evo", "dip-go", "schedule"])
def test_a_search_beats_even_steps(make_task: MakeTask, name: str) -> None:
    task = make_task(20, calls=24)
    even, searched = (task.error(found_by(one, task).schedule, task.calls) for one in ("interval", name))
    assert searched < even


LEAST = {"deepcache": 24, "delta-dit": 15, "l2c": 30, "teacache": 12, "dbcache": 15}
"""Cells of 10 x 6 that a search cannot do without; step 0 for the others."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [(name, LEAST.get(name, 6)) for name in NAMES])
def test_a_budget_out_of_reach_is_refused_and_the_next_cell_is_not(make_task: MakeTask, name: str, least: int) -> None:
    sparsity = f"{1 - least / 60:.4g}"
    with pytest.raises(CalibrationError, match=rf"'{name}' computes at least {least} of the 10 x 6 .* of {sparsity};"):
        row_of(name).search(make_task(least - 1))
    with pytest.raises(CalibrationError, match=f"leaves {least - 1}"):
        row_of(name).require_reach(10, 6, least - 1)
    found = found_by(name, make_task(least))
    assert int((found.schedule == Source.COMPUTE).sum()) == least


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_call_is_enough(make_task: MakeTask, name: str) -> None:
    found = found_by(name, make_task(BUDGET, calls=1))
    assert int((found.schedule == Source.COMPUTE).sum()) <= BUDGET


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(CalibrationError, match="some of schedule, tts-paper, interval, .* loops, .*; found 'magic'"):
        rows_of(("schedule", "magic"))
    with pytest.raises(CalibrationError, match="found none"):
        rows_of(())


def test_fewer_intervals_than_a_search_has(make_task: MakeTask) -> None:
    task = make_task(BUDGET)
    assert found_by("evo", task, 2).notes == {"generations": 2}
    assert found_by("evo", task, 1000).notes == {"generations": 4}


def test_names_are_given_once_and_one_of_them_makes_the_first_plan() -> None:
    """Each row has a maker, and says what is learned, or what it is from."""
    names = [row.name for row in PROPOSERS]
    assert len(set(names)) == len(names)
    assert all(row.what and pkgutil.resolve_name(f"ttscompile.{row.maker}").__doc__ for row in PROPOSERS)
    assert [row.name for row in SCHEDULES if row.corrects] == ["schedule"]
    assert [row.name for row in SCHEDULES if row.baseline] == ["interval"]
    assert {row.name for row in PROPOSERS if row.anew} == {*NAMES, "loops"}
    for two in (("schedule", "bac"), ("interval", "bac"), ("tts-paper", "loops")):
        found = " and ".join(map(repr, two))
        with pytest.raises(CalibrationError, match=f"one that makes the first plan; found {found}. Take one of them."):
            rows_of((*reversed(two), "weights"))


def test_they_propose_in_the_order_of_the_table() -> None:
    assert [row.name for row in rows_of(("weights", "precision", "bac"))] == ["bac", "precision", "weights"]


def test_a_name_without_a_maker_is_an_error(make_task: MakeTask) -> None:
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        ScheduleRow("magic", "nothing", "rivals.bac:magic").search(make_task(BUDGET))
    with pytest.raises(ModuleNotFoundError, match="magic"):
        ScheduleRow("magic", "nothing", "rivals.magic:magic").search(make_task(BUDGET))


def test_the_table_is_read_without_torch() -> None:
    code = "import sys, ttscompile.calibration.proposers; print(sorted({'onnx', 'torch'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


@pytest.mark.slow
def test_what_calibrates_without_a_rival_imports_none() -> None:
    code = (
        "import pkgutil, sys; from ttscompile.calibration import pipeline, proposers as those\n"
        "for row in those.PROPOSERS:\n"
        "    row in those.RIVALS or pkgutil.resolve_name('ttscompile.' + row.maker)\n"
        "print('ttscompile.calibration.tts' in sys.modules, [n for n in sys.modules if 'ttscompile.rivals.' in n])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "True []\n"


def test_nobody_asks_for_a_rival_by_its_name() -> None:
    """What depends on it is a property of its row."""
    asked = re.compile(rf"""(==|!=|\bin|\bcase) \(?["'](?:{"|".join(re.escape(row.name) for row in RIVALS)})["']""")
    package = Path(ttscompile.__file__).parent
    found = [
        f"{path.relative_to(package)}:{number}: {line.strip()}"
        for path in package.rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if asked.search(line)
    ]
    assert found == []
    assert asked.search('if name == "tts-paper":')
    assert asked.search('if name in ("sag", "l2c"):')
