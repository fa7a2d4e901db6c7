"""Plans on the lattice: ``origins`` against the semantics executed cell by cell, legality, legalisation."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile.core.lattice import (
    UNWRITTEN,
    Source,
    check_plan,
    dense_plan,
    illegal_cells,
    legalize,
    origins,
    plan_flops,
    require_legal,
    sparsity,
    uniform_plan,
)
from ttscompile.errors import IllegalPlanError

GROUPS = [0, 1, 2, 0, 1, 2]


@st.composite
def plans(draw: st.DrawFn, steps: int = 5) -> np.ndarray:
    cells = draw(st.lists(st.integers(0, 3), min_size=steps * len(GROUPS), max_size=steps * len(GROUPS)))
    return np.array(cells, np.int8).reshape(steps, len(GROUPS))


written_masks = st.lists(st.booleans(), min_size=30, max_size=30).map(lambda cells: np.array(cells).reshape(5, 6))


def literal_origins(plan: np.ndarray) -> np.ndarray:
    """docs/design.md section 2, cell by cell; rollout cells are their own index."""
    forward: dict[int, int] = {}
    timestep: dict[int, int] = {}
    found = np.full(plan.shape, UNWRITTEN)
    for k in range(plan.shape[0]):
        for b in range(plan.shape[1]):
            own = k * plan.shape[1] + b
            match plan[k, b]:
                case Source.COMPUTE:
                    forward[GROUPS[b]] = timestep[b] = found[k, b] = own
                case Source.FORWARD:
                    found[k, b] = forward.get(GROUPS[b], UNWRITTEN)
                case Source.TIMESTEP:
                    found[k, b] = timestep.get(b, UNWRITTEN)
                case Source.ROLLOUT:
                    found[k, b] = own
    return found


@given(plans())
def test_origins_are_what_the_semantics_say(plan: np.ndarray) -> None:
    resolved = origins(plan, GROUPS)
    np.testing.assert_array_equal(resolved.cell, literal_origins(plan))
    np.testing.assert_array_equal(resolved.rollout, plan == Source.ROLLOUT)


@given(plans(), written_masks)
def test_legalised_plans_are_legal_and_legal_plans_are_left_alone(plan: np.ndarray, written: np.ndarray) -> None:
    before = plan.copy()
    legal, changed = legalize(plan, GROUPS, written)
    np.testing.assert_array_equal(plan, before)
    assert not illegal_cells(legal, GROUPS, written).any()
    assert changed == np.count_nonzero(legal != plan)
    again, none = legalize(legal, GROUPS, written)
    np.testing.assert_array_equal(again, legal)
    assert none == 0


@given(plans(), written_masks)
def test_legalising_changes_only_what_has_to_change(plan: np.ndarray, written: np.ndarray) -> None:
    plan[0] = Source.COMPUTE
    legal, _ = legalize(plan, GROUPS, written)
    np.testing.assert_array_equal(legal != plan, (plan == Source.ROLLOUT) & ~written)
    assert set(legal[legal != plan]) <= {Source.TIMESTEP}


def test_legalise_takes_a_plan_for_each_stream() -> None:
    plan = np.stack([dense_plan(2, 2), np.array([[0, 0], [3, 3]], np.int8)])
    written = np.zeros((2, 2, 2), bool)
    legal, changed = legalize(plan, [0, 1], written)
    assert changed == 2 and legal.shape == (2, 2, 2)


def test_a_reuse_writes_nothing() -> None:
    # Block 0 computes at steps 0 and 2; at step 3 block 2 reads forward[0], which block 0 wrote at step 2.
    plan = np.array([[0, 0, 0], [2, 2, 1], [0, 2, 2], [2, 2, 1]], np.int8)
    cell = origins(plan, [0, 1, 0]).cell
    assert cell[1, 2] == 2  # the last computed block of the kind, in order of execution: block 2 of step 0
    assert cell[3, 2] == 6  # block 0 of step 2
    assert cell[3, 0] == 6 and cell[3, 1] == 1


def test_illegal_plans_are_refused_with_the_first_cell() -> None:
    written = np.zeros((1, 2, 2), bool)
    with pytest.raises(IllegalPlanError, match="step 0, block 1 .step 0 must be dense.; 1 illegal"):
        require_legal(np.array([[[0, 2], [0, 0]]], np.int8), [0, 0], written)
    with pytest.raises(IllegalPlanError, match="step 1, block 0 .its ROLLOUT residual was never computed"):
        require_legal(np.array([[[0, 0], [3, 2]]], np.int8), [0, 0], written)
    require_legal(np.array([[[0, 0], [3, 2]]], np.int8), [0, 0], np.array([[[False, False], [True, False]]]))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (np.zeros((3, 2)), "dtype float64"),
        (np.zeros((2, 3), int), r"shape \(2, 3\); expected"),
        (np.full((3, 2), 4), "values 4..4"),
        (np.full((3, 2), -1), "values -1..-1"),
        (np.zeros((5, 3, 2), int), r"\(4, 3, 2\)"),
    ],
)
def test_malformed_plans_are_refused(plan: np.ndarray, message: str) -> None:
    with pytest.raises(IllegalPlanError, match=message):
        check_plan(plan, steps=3, blocks=2, streams=4)


def test_check_plan_gives_every_stream_a_row() -> None:
    assert check_plan(np.zeros((3, 2), int), 3, 2, streams=4).shape == (4, 3, 2)


def test_uniform_plan_and_its_cost() -> None:
    plan = uniform_plan(100, 24, 5)
    assert list(np.flatnonzero((plan == 0).all(1))) == [0, 20, 40, 60, 80]
    assert sparsity(plan) == pytest.approx(0.95)
    assert plan_flops(plan, np.arange(24)) == 5 * sum(range(24))
