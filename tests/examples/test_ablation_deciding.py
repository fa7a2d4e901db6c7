"""Deciding on the way, on errors that are made up: where the estimate tells which calls need more, and where not."""

from __future__ import annotations

import numpy as np
import pytest
from deciding import Array, Family, Fixed, Steps, best_family, common, cost, decided, rank_correlation

CALLS, EPISODES = 400, 20
SHORT, MIDDLE, LONG = (0, 4), (0, 4, 7), (0, 4, 6, 7, 8)
OTHERS = ((0,), (0, 6), (0, 5, 8), (0, 3, 5, 7))


def made(seed: int, told: float) -> tuple[dict[Steps, Array], Array]:
    """Errors of schedules, and estimates that tell of each call how hard it is: exactly (1), or not at all (0)."""
    draw = np.random.default_rng(seed)
    hard, luck = draw.standard_normal((2, CALLS))
    errors: dict[Steps, Array] = {one: np.exp(2 * hard) / 2.0 ** len(one) for one in (SHORT, MIDDLE, LONG, *OTHERS)}
    return errors, np.exp(told * hard + (1 - told) * luck)


def fixed_of(errors: dict[Steps, Array]) -> Fixed:
    chosen = {2: (0, 6), 3: (0, 5, 8), 4: (0, 3, 5, 7), 5: LONG}
    return Fixed({count: errors[one] for count, one in chosen.items()}, np.arange(CALLS) % EPISODES, 0)


def test_what_is_computed_beyond_the_common_beginning_is_in_vain() -> None:
    assert common(SHORT, LONG) == 2 and common(MIDDLE, LONG) == 2 and common((0,), (0,)) == 1
    assert cost(SHORT, LONG) == 5 and cost(SHORT, SHORT) == 2
    assert cost(MIDDLE, LONG) == 6 and cost(LONG, MIDDLE) == 6
    assert cost((0, 6), (0, 5, 8)) == 4


def test_hard_calls_get_more_steps_where_the_estimate_tells_them() -> None:
    learned, estimates = made(0, 1.0)
    family = best_family(learned, lambda at: estimates, 3.0, 6, False)
    assert family is not None and not family.returns and family.at == SHORT
    judged, others = made(1, 1.0)
    rows = decided(family, judged, (estimates, others), fixed_of(judged))
    by_estimate, chance, after = rows
    assert by_estimate.evaluations == pytest.approx(3, abs=0.25) and by_estimate.most <= 6
    assert by_estimate.gain is not None and by_estimate.gain[0] > 0.2 and by_estimate.gain[1] > 0.1
    assert by_estimate.rank == pytest.approx(1)
    assert chance.gain is not None and chance.gain[0] < 0
    assert after.error <= by_estimate.error and after.evaluations <= by_estimate.evaluations + 1e-9


def test_an_estimate_that_tells_nothing_gains_nothing() -> None:
    learned, estimates = made(0, 0.0)
    family = best_family(learned, lambda at: estimates, 3.0, 6, False)
    assert family is not None
    judged, others = made(1, 0.0)
    by_estimate = decided(family, judged, (estimates, others), fixed_of(judged))[0]
    assert by_estimate.gain is not None and by_estimate.gain[1] < 0.02
    assert by_estimate.rank == pytest.approx(0, abs=0.15)


def test_the_bound_and_the_mean_hold_on_the_calls_learned_from() -> None:
    learned, estimates = made(0, 1.0)
    for bound, evaluations in ((3, 2.5), (4, 3.0), (6, 3.5)):
        family = best_family(learned, lambda at: estimates, evaluations, bound, False)
        assert family is not None and max(family.costs) <= bound
        chosen = family.chosen(estimates, family.thresholds(estimates))
        assert np.array(family.costs)[chosen].mean() <= evaluations + 1e-9
    assert best_family(learned, lambda at: estimates, 1.5, 6, False) is None


def test_going_back_is_found_apart() -> None:
    learned, estimates = made(0, 1.0)
    family = best_family(learned, lambda at: estimates, 3.5, 6, True)
    assert family is not None and family.returns
    assert any(ending[: len(family.at)] != family.at for ending in family.endings)


def test_a_mixture_of_two_fixed_numbers() -> None:
    errors = {2: np.array([1.0, 3.0]), 3: np.array([0.0, 1.0])}
    mixed = Fixed(errors, np.array([0, 1]), 0).mixed(2.25)
    assert mixed.error == pytest.approx(0.75 * 2 + 0.25 * 0.5) and mixed.most == 3
    assert mixed.tail == (3.0, 3.0, 3.0)


def test_the_worst_of_a_mixture_is_that_of_the_calls_that_count() -> None:
    errors = {2: np.array([1.0, 9.0]), 3: np.array([0.0, 1.0])}
    assert Fixed(errors, np.array([0, 1]), 0).mixed(3.0).tail == (1.0, 1.0, 1.0)


def test_the_gain_is_that_over_the_mixture() -> None:
    errors = {2: np.array([1.0, 3.0]), 3: np.array([0.0, 1.0])}
    fixed = Fixed(errors, np.array([0, 1]), 0)
    row = fixed.row("half", np.array([[1.0, 3.0], [0.2, 0.5]]), np.array([2, 3]), np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert row.evaluations == 2.5 and row.error == pytest.approx(0.75)
    assert row.gain is not None and row.gain[0] == pytest.approx(1 - 0.75 / 1.25)
    assert row.gain[1] <= row.gain[0] <= row.gain[2]


def test_rank_correlation() -> None:
    one = np.array([1.0, 2.0, 3.0, 4.0])
    assert rank_correlation(one, one**3) == pytest.approx(1)
    assert rank_correlation(one, -one) == pytest.approx(-1)
    assert rank_correlation(one, np.ones(4)) == 0


def test_thresholds_divide_calls_as_they_were_learned() -> None:
    family = Family(SHORT, (SHORT, LONG), (0.75,))
    estimates = np.arange(100.0)
    chosen = family.chosen(estimates, family.thresholds(estimates))
    assert chosen.mean() == pytest.approx(0.25, abs=0.01) and chosen[-1] == 1
