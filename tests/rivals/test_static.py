"""Rules without a search, drawn by hand: C is computed, a dot is the block's last residual."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.tasks import MakeTask, found_by, row_of
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.errors import CalibrationError
from ttscompile.rivals import gates, static
from ttscompile.rivals.gates import Gates


def drawn(plan: PlanArray) -> list[str]:
    """One word a step, one letter a block."""
    letters = {Source.COMPUTE: "C", Source.TIMESTEP: ".", Source.FORWARD: "f"}
    return ["".join(letters[Source(int(cell))] for cell in row) for row in plan]


def test_deepcache_keeps_the_outermost_blocks_fresh() -> None:
    assert drawn(static.edge_plan(6, 5, 2, 1)) == ["CCCCC", "C...C", "C...C", "CCCCC", "C...C", "C...C"]


def test_deepcache_spends_the_budget_on_full_steps() -> None:
    found = static.edge_plans(6, 5, budget=21)
    assert [parameters for _, parameters in found] == [{"edge": 1, "full_steps": 3}]  # 3 * 5 + 3 * 2
    assert drawn(found[0][0]) == ["CCCCC", "C...C", "CCCCC", "C...C", "CCCCC", "C...C"]
    wider = static.edge_plans(6, 5, budget=27)  # 5 * 5 + 2, and 3 * 5 + 3 * 4
    assert [parameters for _, parameters in wider] == [{"edge": 1, "full_steps": 5}, {"edge": 2, "full_steps": 3}]


@pytest.mark.parametrize("blocks", [1, 2])
def test_deepcache_with_nothing_between_the_outermost_blocks_is_refused(blocks: int) -> None:
    with pytest.raises(CalibrationError, match="a sparsity of 0;"):
        row_of("deepcache").require_reach(4, blocks, 3 * blocks)


def test_delta_dit_keeps_the_front_fresh_and_then_the_rear() -> None:
    plan = static.delta_plan(8, 4, full_steps=2, fresh=1, boundary=6)
    assert drawn(plan) == ["CCCC", "C...", "C...", "C...", "CCCC", "C...", "...C", "...C"]


def test_delta_dit_spends_the_budget_on_full_steps() -> None:
    found = static.delta_plans(8, 4, budget=17)  # 3 * 4 + 5 * 1, or 8 * 2 and no full step
    assert [parameters for _, parameters in found] == [
        {"fresh": 1, "full_steps": 3, "boundary": boundary} for boundary in (2, 4, 6)
    ]
    assert all(int((plan == Source.COMPUTE).sum()) == 17 for plan, _ in found)


def test_delta_dit_of_one_block_is_refused() -> None:
    with pytest.raises(CalibrationError, match="a sparsity of 0;"):
        row_of("delta-dit").require_reach(4, 1, 3)


def test_a_rule_takes_the_parameters_with_the_lowest_error(make_task: MakeTask) -> None:
    task = make_task(34)
    found = found_by("delta-dit", task)
    plans = [plan for plan, _ in static.delta_plans(10, 6, 34)]
    errors = [task.error(plan, task.calls) for plan in plans]
    assert len(plans) > 3
    np.testing.assert_array_equal(found.schedule, plans[int(np.argmin(errors))])
    assert np.ptp(errors) > 0.001  # else any would do


def test_gates_compute_the_cells_with_the_highest_scores(make_task: MakeTask) -> None:
    task = make_task(34)
    search = Gates(task, Source.FORWARD)
    scores = np.arange(60.0).reshape(10, 6)
    search.restore({**search.state(), "scores": scores})
    words = drawn(search._cells(8))
    assert words == ["CCCCCC", *["ffffff"] * 8, "ffffCC"]
    every_other = Gates(task, Source.TIMESTEP, whole=2)
    every_other.restore({**every_other.state(), "scores": -scores})
    words = drawn(every_other._cells(32))
    assert words == ["CCCCCC", "CC...."] + ["CCCCCC", "......"] * 4


def test_gates_move_to_where_the_error_falls_and_shrink_to_the_budget(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cell whose slope is always the lowest is chosen, one whose slope is always the highest is dropped."""
    good, bad = (3, 2), (5, 5)
    seen: list[int] = []

    def slopes(runner: object, actions: object, plan: PlanArray, reuse: Source, calls: object) -> np.ndarray:
        seen.append(int((plan == Source.COMPUTE).sum()))
        gradient = np.zeros((10, 6), np.float32)
        gradient[good], gradient[bad] = -1, 1
        return gradient

    monkeypatch.setattr(gates, "slopes", slopes)
    monkeypatch.setattr(Gates, "intervals", 12)
    task = make_task(20)
    search = Gates(task, Source.TIMESTEP)
    for interval in range(12):
        search.advance(interval)
    last = search._cells(20)
    assert last[good] == Source.COMPUTE
    assert last[bad] == Source.TIMESTEP
    assert seen[0] > 20
    assert seen == sorted(seen, reverse=True)
    assert seen[-6:] == [20] * 6
