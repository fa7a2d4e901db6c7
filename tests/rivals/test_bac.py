"""BAC: its dynamic programme against brute force, its union and its spending by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.calibration.tasks import MakeTask, found_by
from tests.rounding import Counted, assert_equal_but_for_rounding, bound
from ttscompile.core.lattice import Source
from ttscompile.rivals.bac import Schedule, best_schedules, bubbling, dense_residuals, spend, statistics, union


def score(similarity: np.ndarray, steps: tuple[int, ...]) -> float:
    """What reusing each computation until the next one scores, literally."""
    ends = (*steps[1:], len(similarity))
    return float(sum(similarity[a, t] for a, end in zip(steps, ends, strict=True) for t in range(a, end)))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_the_schedules_are_the_best_of_all(seed: int, steps: int) -> None:
    similarity = np.random.default_rng(seed).standard_normal((steps, steps))
    found = best_schedules(similarity, steps)
    assert len(found) == steps
    for count, schedule in enumerate(found, 1):
        every = [(0, *rest) for rest in itertools.combinations(range(1, steps), count - 1)]
        best = max(every, key=lambda chosen: score(similarity, chosen))
        assert tuple(np.flatnonzero(schedule.computed)) == best
        assert schedule.score == pytest.approx(score(similarity, best))


def test_a_block_that_changes_once_is_computed_there() -> None:
    """By hand: steps 0..2 are alike, and 3..5; everything else has similarity 0."""
    similarity: np.ndarray = np.kron(np.eye(2), np.ones((3, 3)))
    one, two, _ = best_schedules(similarity, 3)
    assert (one.score, two.score) == (3, 6)
    np.testing.assert_array_equal(np.flatnonzero(two.computed), [0, 3])


def test_the_blocks_that_change_most_follow_the_feed_forward_blocks_after_them() -> None:
    kinds = ["self_attention", "feed_forward"] * 4
    change = np.array([9.0, 1, 8, 7, 0, 6, 5, 2])
    assert bubbling(change, kinds) == {0: [1, 3, 5, 7], 2: [3, 5, 7], 3: [3, 5, 7], 5: [5, 7], 6: [7]}
    assert bubbling(np.array([1.0, 2]), ["odd", "even"]) == {1: [1], 0: [0, 1]}  # unknown structure: all of them


def test_the_union_adds_the_updates_of_others_and_not_what_these_took_over() -> None:
    own = [np.array([True, flag, other]) for flag, other in [(False, False), (True, False), (False, True)]]
    cells = union(own, {0: [1], 1: [2]})
    np.testing.assert_array_equal(cells.T.astype(int), [[1, 1, 0], [1, 1, 1], [1, 0, 1]])


def _schedules(*rows: tuple[list[int], float]) -> list[Schedule]:
    return [Schedule(np.isin(np.arange(6), steps), points) for steps, points in rows]


def test_the_budget_goes_to_all_blocks_alike_and_then_to_those_that_gain_most() -> None:
    first = _schedules(([0], 0.0), ([0, 3], 1.0), ([0, 2, 4], 2.0))
    second = _schedules(([0], 0.0), ([0, 3], 1.0), ([0, 2, 5], 9.0))
    assert spend([first, second], {}, 2) == [1, 1]
    assert spend([first, second], {}, 3) == [2, 1]
    assert spend([first, second], {}, 5) == [2, 3]
    assert spend([first, second], {}, 60) == [3, 3]
    # With the union block 0 also has the updates of block 1.
    assert spend([first, second], {0: [1]}, 5) == [2, 2]  # {0, 3} and {0, 3}; any third computation makes it 6 or 7
    assert spend([first, second], {0: [1]}, 6) == [3, 2]  # {0, 2, 4, 3} and {0, 3}; {0, 3, 2, 5} and {0, 2, 5} are 7
    assert spend([first, second], {0: [1]}, 7) == [3, 3]  # {0, 2, 4, 5} and {0, 2, 5}


@pytest.mark.slow
def test_statistics_of_a_dense_call(make_task: MakeTask) -> None:
    task = make_task(20)
    calls = task.runner.select(task.calls, [0, 1])
    residuals = dense_residuals(task.runner, calls)
    similarity, change = statistics(residuals)
    assert similarity.shape == (6, 10, 10)
    one, other = (residuals[4][0, k].double().numpy() for k in (2, 7))
    again = residuals[4][1].double().numpy()
    cosines = [a @ b / np.linalg.norm(a) / np.linalg.norm(b) for a, b in ((one, other), (again[2], again[7]))]
    assert similarity[4, 2, 7] == pytest.approx(np.mean(cosines), abs=3 * bound(one.size))  # a product, two norms
    pairs = [np.abs(rows[t] - rows[u]).mean() for rows in residuals[4].numpy() for t in range(10) for u in range(10)]
    assert change[4] == pytest.approx(np.mean(pairs), rel=bound(100 * one.size))


def test_the_residuals_are_those_of_the_reference(make_task: MakeTask) -> None:
    task = make_task(20)
    calls = task.runner.select(task.calls, [3])
    dense = np.zeros((10, 6), np.int8)
    with Counted() as counted:
        rollout = task.runner.model.denoise(calls.contexts, calls.initial, calls.noise, dense)
    residuals = dense_residuals(task.runner, calls)
    for (k, b), expected in rollout.cache.residuals.items():
        assert_equal_but_for_rounding(residuals[b][0, k], expected.flatten(), counted.terms)


def test_the_plan_reads_timestep_only(make_task: MakeTask) -> None:
    found = found_by("bac", make_task(20))
    assert set(np.unique(found.schedule)) == {Source.COMPUTE, Source.TIMESTEP}
