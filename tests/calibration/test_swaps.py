"""Proposals against brute force on small linear models."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ttscompile.calibration.linear import LinearModel
from ttscompile.calibration.swaps import propose

STEPS, BLOCKS, SIZE = 5, 3, 4


def random_model(seed: int) -> LinearModel:
    draw = np.random.default_rng(seed)
    added = draw.standard_normal((BLOCKS, STEPS, STEPS, SIZE)).astype(np.float32)
    reach = np.concatenate([np.zeros((BLOCKS, 1, STEPS, SIZE), np.float32), np.cumsum(added, 1)], 1)
    computed = draw.random((STEPS, BLOCKS)) < 0.3
    computed[0] = True
    computed[2, 1], computed[3, 0] = True, False
    return LinearModel(reach, 4 * draw.standard_normal(SIZE).astype(np.float32), computed)


def squared_error(models: list[LinearModel], computed: np.ndarray) -> float:
    total = 0.0
    for model in models:
        change = sum(model.change(b, np.flatnonzero(computed[:, b])) for b in range(BLOCKS))
        total += float(((model.error + change) ** 2).sum())
    return total


def exchanges(computed: np.ndarray) -> list[np.ndarray]:
    cells = list(itertools.product(range(1, STEPS), range(BLOCKS)))
    found = []
    for out, into in itertools.product(cells, cells):
        if computed[out] and not computed[into]:
            other = computed.copy()
            other[out], other[into] = False, True
            found.append(other)
    return found


@pytest.mark.parametrize("seed", range(10))
def test_a_proposal_is_the_best_exchange(seed: int) -> None:
    models = [random_model(seed), random_model(seed + 100)]
    models[1].computed = models[0].computed
    budget = int(models[0].computed.sum())
    best = min(squared_error(models, other) for other in exchanges(models[0].computed))
    before = squared_error(models, models[0].computed)
    proposals = propose(models, budget, 1)
    if best >= before:
        assert proposals == []
    else:
        assert squared_error(models, proposals[0]) == pytest.approx(best, rel=1e-4)
        assert proposals[0].sum() == budget


@pytest.mark.parametrize("seed", range(5))
def test_proposals_go_on_from_each_other_within_the_budget_and_leave_the_models_alone(seed: int) -> None:
    model = random_model(seed)
    model.error *= 5
    error, computed = model.error.copy(), model.computed.copy()
    budget = int(computed.sum())
    proposals = propose([model], budget, 6)
    errors = [squared_error([model], plan) for plan in [computed, *proposals]]
    assert proposals
    assert all(after < before for before, after in itertools.pairwise(errors))
    assert all(plan.sum() == budget and plan[0].all() for plan in proposals)
    np.testing.assert_array_equal(model.error, error)
    np.testing.assert_array_equal(model.computed, computed)


def test_cells_are_added_while_the_budget_allows() -> None:
    model = random_model(0)
    budget = int(model.computed.sum()) + 2
    proposals = propose([model], budget, 4)
    assert [int(plan.sum()) for plan in proposals[:2]] == [budget - 1, budget]
    assert all(plan.sum() <= budget for plan in proposals)


def test_nothing_is_proposed_when_step_0_takes_the_whole_budget() -> None:
    model = random_model(0)
    model.computed[1:] = False
    assert propose([model], BLOCKS, 3) == []
