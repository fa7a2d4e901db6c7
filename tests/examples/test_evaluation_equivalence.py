"""Whether a variant is as good as the first: intervals of shares, and what they are called."""

import bootstrap
import numpy as np
import pytest
from bootstrap import Estimate, estimate, paired_difference_of_shares, share
from equivalence import EQUIVALENT, FEWEST, TOO_FEW, WORSE, joined, verdict


def pairs(both: int, first: int, second: int, none: int) -> tuple[list[float], list[float]]:
    """Episodes that both variants solve, only the first, only the second, and neither."""
    return [1.0] * (both + first) + [0.0] * (second + none), [1.0] * both + [0.0] * first + [1.0] * second + [
        0.0
    ] * none


@pytest.mark.parametrize(
    ("ones", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_shares_have_the_published_intervals(ones: int, of: int, low: float, high: float) -> None:
    """Newcombe, Statistics in Medicine 17 (1998) 857, table I, method 3."""
    found = share([1.0] * ones + [0.0] * (of - ones))
    assert (round(found.low, 4), round(found.high, 4)) == (low, high)
    other = share([0.0] * ones + [1.0] * (of - ones))
    assert (other.low, other.high) == pytest.approx((1 - found.high, 1 - found.low))


def test_differences_of_shares_have_the_published_interval() -> None:
    """Newcombe, Statistics in Medicine 17 (1998) 2635, table II, method 10: 36, 12, 2 and 0 of 50 pairs."""
    found = paired_difference_of_shares(*pairs(36, 12, 2, 0))
    assert found.mean == pytest.approx(0.2)
    assert (round(found.low, 4), round(found.high, 4)) == (0.0569, 0.3404)


def test_few_episodes_that_all_succeed_prove_nothing() -> None:
    found = paired_difference_of_shares(*pairs(20, 0, 0, 0))
    assert found.mean == 0 and found.low < -0.1


def test_intervals_of_shares_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(1000):
        base = rng.random(80) < 0.9
        own = np.where(rng.random(80) < 0.2, rng.random(80) < 0.9, base)  # a fifth is drawn again: correlated, no loss
        found = paired_difference_of_shares(own.astype(float), base.astype(float))
        held += found.low <= 0 <= found.high
    assert 930 <= held <= 990


def scores(mean: float, deviation: float, count: int) -> list[float]:
    """With exactly this mean and spread."""
    values = np.linspace(-1, 1, count)
    return list(mean + deviation * (values - values.mean()) / values.std())


def test_a_difference_within_the_margin_is_equivalence_even_where_it_can_be_told() -> None:
    found = verdict(scores(-0.01, 0.01, 400), [0.0] * 400, 0.03)
    assert found.difference.high < 0
    assert (found.word, found.enough) == (EQUIVALENT, None)


def test_a_loss_beyond_the_margin_is_worse() -> None:
    found = verdict(scores(-0.1, 0.1, 400), [0.0] * 400, 0.03)
    assert (found.word, found.enough) == (WORSE, None)


def test_too_few_episodes_say_how_many_would_do() -> None:
    few = verdict(scores(0.0, 0.2, 100), [0.0] * 100, 0.03)
    assert few.word == TOO_FEW and few.enough is not None
    assert 330 < few.enough < 370  # ((1.96 + 0.84) * 0.2 / 0.03) ** 2 = 349
    assert verdict(scores(0.0, 0.2, few.enough + 20), [0.0] * (few.enough + 20), 0.03).word == EQUIVALENT
    assert str(few).startswith("too few episodes: ") and str(few).endswith(f"; {few.enough} would do")


def test_too_few_episodes_for_a_loss_say_how_many_show_it() -> None:
    found = verdict(scores(-0.05, 0.2, 40), [0.0] * 40, 0.03)
    assert found.word == TOO_FEW and found.enough is not None and 110 < found.enough < 150
    assert verdict(scores(-0.05, 0.2, 130), [0.0] * 130, 0.03).word == WORSE


@pytest.mark.parametrize(("mean", "word"), [(0.0, EQUIVALENT), (-0.05, WORSE)])
@pytest.mark.parametrize("comparisons", [1, 10])
def test_so_many_episodes_would_do_in_four_of_five_cases(
    mean: float, word: str, comparisons: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of scores, in 200 runs. It would be half of them if the interval just had to be as narrow as the room."""
    few = verdict(scores(mean, 0.2, 40), [0.0] * 40, 0.03, comparisons=comparisons)
    assert few.word == TOO_FEW and few.enough is not None
    monkeypatch.setattr(bootstrap, "RESAMPLES", 500)
    rng, zeros = np.random.default_rng(0), np.zeros(few.enough)
    runs = (verdict(rng.normal(mean, 0.2, few.enough), zeros, 0.03, comparisons=comparisons) for _ in range(200))
    assert 0.7 <= sum(each.word == word for each in runs) / 200 <= 0.92


def test_so_many_shares_would_do_in_four_of_five_cases() -> None:
    """A policy that solves a third of its episodes, half of them at random."""
    rng = np.random.default_rng(0)

    def run(episodes: int) -> tuple[list[float], list[float]]:
        same = rng.random(episodes) < 0.5
        base, own = rng.random((2, episodes)) < 1 / 3
        return list(np.where(same, base, own).astype(float)), list(base.astype(float))

    few = verdict(*pairs(50, 25, 25, 140), 0.05, shares=True)
    assert few.word == TOO_FEW and few.enough is not None and 600 < few.enough < 1000
    settled = sum(verdict(*run(few.enough), 0.05, shares=True).word == EQUIVALENT for _ in range(200))
    assert 0.7 <= settled / 200 <= 0.92


@pytest.mark.parametrize("mean", [0.0, -0.01])
def test_scores_of_a_few_episodes_prove_no_equivalence(mean: float) -> None:
    """Resampling knows no loss that none of them had."""
    two = verdict([0.5 + mean] * 2, [0.5] * 2, 0.03)
    assert (two.word, two.enough) == (TOO_FEW, FEWEST)
    assert str(two).endswith(f"; {FEWEST} would do")
    assert verdict([0.5 + mean] * (FEWEST - 1), [0.5] * (FEWEST - 1), 0.03).word == TOO_FEW
    assert verdict([0.5 + mean] * FEWEST, [0.5] * FEWEST, 0.03).word == EQUIVALENT
    wide = verdict([0.5 + mean, 0.54 + mean, 0.46 + mean], [0.5] * 3, 0.03)
    assert wide.word == TOO_FEW and wide.enough is not None and wide.enough >= FEWEST


def test_a_loss_that_a_few_scores_show_is_worse() -> None:
    assert verdict([0.3] * 8, [0.5] * 8, 0.03).word == WORSE


def test_resampling_in_portions_is_resampling_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same random numbers, however many are held."""
    values = np.random.default_rng(3).random(37)
    found = estimate(values)
    picks = np.random.default_rng(0).integers(0, 37, size=(bootstrap.RESAMPLES, 37))
    low, high = np.quantile(values[picks].mean(axis=1), [0.025, 0.975])
    assert (found.low, found.high) == (low, high)
    monkeypatch.setattr(bootstrap, "PORTION", 333)
    assert estimate(values) == found


def test_comparisons_share_their_error() -> None:
    alone, among = (verdict(scores(0.0, 0.2, 180), [0.0] * 180, 0.03, comparisons=n) for n in (1, 10))
    assert (alone.word, among.word) == (EQUIVALENT, TOO_FEW)
    assert among.difference.low < alone.difference.low


def test_a_margin_is_positive() -> None:
    with pytest.raises(ValueError, match="a margin above 0; found 0"):
        verdict([1.0], [1.0], 0)


def test_the_worst_measure_decides() -> None:
    zero = [0.0] * 400
    good, bad, open_ = (verdict(scores(m, s, 400), zero, 0.03) for m, s in ((0, 0.01), (-0.1, 0.01), (0, 1.0)))
    assert joined([good, good]) == EQUIVALENT
    assert joined([good, open_]) == TOO_FEW
    assert joined([open_, bad]) == WORSE


def test_an_estimate_prints_its_interval() -> None:
    assert str(Estimate(0.5, 0.25, 0.75)) == "0.500 [0.250, 0.750]"
