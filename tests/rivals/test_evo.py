"""The genetic search: its operations keep what they promise, and no generation is worse than the one before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tests.calibration.tasks import MakeTask
from tests.rounding import Counted, allowed
from ttscompile.calibration.step_counts import spacings
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.rivals.evo import POPULATION, Evo, mutate, repair


@given(st.data())
def test_repair_keeps_the_budget_and_the_least_cells_of_a_block(data: st.DataObject) -> None:
    steps, blocks = data.draw(st.integers(1, 8)), data.draw(st.integers(1, 5))
    least = data.draw(st.integers(1, steps))
    budget = data.draw(st.integers(least * blocks, steps * blocks))
    draw = np.random.default_rng(data.draw(st.integers(0, 999)))
    computed = draw.random((steps, blocks)) < data.draw(st.floats(0, 1))
    before = computed.copy()
    fixed = repair(computed, budget, least, draw)
    assert fixed.sum() == budget
    assert fixed[0].all()
    assert fixed.sum(0).min() >= least
    np.testing.assert_array_equal(computed, before)


def test_repair_leaves_alone_what_is_right() -> None:
    computed = np.array([[1, 1], [0, 1], [1, 0]], np.bool_)
    np.testing.assert_array_equal(repair(computed, 4, 2, np.random.default_rng(0)), computed)


def test_a_mutation_moves_cells_within_their_blocks() -> None:
    computed = np.zeros((10, 3), np.bool_)
    computed[0] = computed[4] = True
    for seed in range(20):
        mutated = mutate(computed, np.random.default_rng(seed))
        assert mutated[0].all()
        changed = np.flatnonzero((mutated != computed).any(0))
        assert len(changed) <= 1  # a tenth of three cells, at least one
        assert (mutated.sum(0) == 2).all()
    first = np.zeros((3, 2), np.bool_)
    first[0] = True
    np.testing.assert_array_equal(mutate(first, np.random.default_rng(0)), first)


def test_generations_get_better_and_begin_with_whole_steps(make_task: MakeTask) -> None:
    task = make_task(26)
    search = Evo(task)
    assert search._population.shape == (POPULATION, 10, 6)
    assert search._population[0][list(spacings(10, 4)[0])].all()
    losses = []
    for generation in range(6):
        search.advance(generation)
        losses.append(search.loss)
        assert (search._population.sum((1, 2)) == 26).all()
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < losses[0]
    with Counted() as counted:
        found = task.error(search.plan, task.calls)
    assert found == pytest.approx(losses[-1], abs=allowed(task.calls.targets, counted.terms))


def test_a_fitness_of_the_callers_is_what_gets_better(make_task: MakeTask) -> None:
    def late(plan: PlanArray) -> float:
        return -float((plan[6:] == Source.COMPUTE).sum())

    search, losses = Evo(make_task(26), late, 8), []
    for generation in range(5):
        search.advance(generation)
        losses.append(search.loss)
    assert search._population.shape == (8, 10, 6)
    assert losses == sorted(losses, reverse=True) and losses[-1] < losses[0]
    assert search.loss == late(search.plan) == late(search.found().schedule)
