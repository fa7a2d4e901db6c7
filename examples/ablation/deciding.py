"""How many steps a call gets, decided on the way from what two nested schedules answer: errors in, figures out.

Schedules are tuples of computed steps. A *family* computes one of them, ``at``, and compares its answer with that of
``at`` without its last step. This difference is the estimate. By thresholds the estimate chooses an ending, another
schedule that begins as ``at`` does. What ``at`` computed beyond that common beginning was in vain, and is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Steps = tuple[int, ...]

CUTS = 20
"""Thresholds are tried at so many even shares of the calls learned from."""

RESAMPLED = 2000
"""Samples of the bootstrap over episodes."""


@dataclass(frozen=True)
class Family:
    """Endings, and the share of the calls that each one gets.

    Attributes:
        at: the schedule whose answer is compared.
        endings: for estimates from small to large.
        shares: of the calls with the smallest estimates that get the first ending, the first two, and so on; one less
            than there are endings.
    """

    at: Steps
    endings: tuple[Steps, ...]
    shares: tuple[float, ...]

    @property
    def costs(self) -> tuple[int, ...]:
        """Evaluations of the network with each ending."""
        return tuple(cost(self.at, ending) for ending in self.endings)

    @property
    def returns(self) -> bool:
        """Whether an ending goes back to before the last step that was computed."""
        return any(ending[: len(self.at)] != self.at for ending in self.endings)

    def thresholds(self, estimates: Array) -> Array:
        """Estimates between which endings change, from those of the calls learned from."""
        return np.quantile(estimates, self.shares)

    def chosen(self, estimates: Array, thresholds: Array) -> Indices:
        """The number of each call's ending, ``[N]``."""
        return np.searchsorted(thresholds, estimates).astype(np.int64)


def common(one: Steps, other: Steps) -> int:
    """How many steps two schedules both begin with."""
    differ = [i for i, (a, b) in enumerate(zip(one, other, strict=False)) if a != b]
    return differ[0] if differ else min(len(one), len(other))


def cost(at: Steps, ending: Steps) -> int:
    """Evaluations of a call that computes ``at``, and then an ending from where the two part."""
    return len(at) + len(ending) - common(at, ending)


def best_family(
    errors: Mapping[Steps, Array], estimate: Callable[[Steps], Array], evaluations: float, bound: int, returns: bool
) -> Family | None:
    """The family with the smallest mean error that needs at most so many evaluations on average; None if there is none.

    Args:
        errors: of all schedules, on the calls that are learned from: ``[N]`` each.
        estimate: of the schedule that is compared, ``[N]``.
        evaluations: of a call, mean.
        bound: evaluations of any call, at most.
        returns: whether an ending goes back to before the last computed step, or none does.
    """
    best: tuple[float, Family] | None = None
    for at in errors:
        if len(at) < 2 or at[:-1] not in errors:
            continue
        by_cost: dict[int, list[Steps]] = {}
        for ending in errors:
            shared = common(at, ending)
            if cost(at, ending) <= bound and shared >= (1 if returns else len(at)):
                by_cost.setdefault(cost(at, ending), []).append(ending)
        found = _best_endings(at, by_cost, errors, estimate(at).argsort(), evaluations)
        if found is not None and found[1].returns == returns and (best is None or found[0] < best[0]):
            best = found
    return None if best is None else best[1]


def _best_endings(
    at: Steps, by_cost: Mapping[int, Sequence[Steps]], errors: Mapping[Steps, Array], order: Indices, evaluations: float
) -> tuple[float, Family] | None:
    """The best three endings at most, and their shares, with their mean error; None where all need too much."""
    ends = np.round(np.linspace(0, len(order), CUTS + 1)).astype(int)
    sums, paid = {}, {}
    for price, endings in by_cost.items():  # of the calls between two cuts, [endings, cuts, cuts]
        total = np.cumsum([np.concatenate([[0.0], errors[one][order]]) for one in endings], 1)[:, ends]
        sums[price] = total[:, None, :] - total[:, :, None]
        paid[price] = price * (ends[None, :] - ends[:, None])
    least, backwards = {price: of.min(0) for price, of in sums.items()}, np.tri(CUTS + 1, k=-1, dtype=bool)
    best: tuple[float, tuple[int, ...], tuple[int, ...]] | None = None
    for first, second, third in combinations_with_replacement(sorted(by_cost), 3):
        spent = paid[first][0, :, None] + paid[second] + paid[third][None, :, -1]
        total = least[first][0, :, None] + least[second] + least[third][None, :, -1]
        total = np.where(backwards | (spent > evaluations * len(order) + 1e-9), np.inf, total) / len(order)
        i, j = np.unravel_index(total.argmin(), total.shape)
        if total[i, j] < (np.inf if best is None else best[0]):
            best = float(total[i, j]), (first, second, third), (0, int(i), int(j), CUTS)
    if best is None:
        return None
    parts = [part for part in zip(best[1], best[2][:-1], best[2][1:], strict=True) if part[1] < part[2]]
    endings = tuple(by_cost[price][sums[price][:, a, b].argmin()] for price, a, b in parts)
    return best[0], Family(at, endings, tuple(float(ends[a]) / len(order) for _, a, _ in parts[1:]))


@dataclass(frozen=True)
class Row:
    """What was measured of one way of spending evaluations.

    Attributes:
        name: what decides.
        evaluations: of a call, mean.
        most: of any call.
        error: mean over the calls.
        tail: the error that 95 %, 99 % and all of the calls have at most.
        gain: share of the error of fixed schedules with as many evaluations that is saved; negative if it is worse. Its
            95 % interval is over episodes.
        rank: correlation of the estimate with the error of the first ending.
    """

    name: str
    evaluations: float
    most: int
    error: float
    tail: tuple[float, ...]
    gain: tuple[float, float, float] | None = None
    rank: float | None = None


class Fixed:
    """Fixed schedules, and what mixtures of two of them would do.

    Args:
        errors: by the number of computed steps, of each call: ``[N]``.
        episodes: of each call, ``[N]``.
    """

    def __init__(self, errors: Mapping[int, Array], episodes: Indices, seed: int) -> None:
        self._counts = np.array(sorted(errors))
        self._errors = np.stack([errors[int(count)] for count in self._counts])
        _, which = np.unique(episodes, return_inverse=True)
        drawn = np.random.default_rng((seed, 9)).integers(0, which.max() + 1, (RESAMPLED, which.max() + 1))
        times = np.stack([np.bincount(one, minlength=which.max() + 1) for one in drawn])
        weights = np.concatenate([np.ones((1, len(which))), times[:, which]])
        self._weights: Array = weights / weights.sum(1, keepdims=True)

    def rows(self) -> list[Row]:
        """One for each."""
        return [
            Row(f"{count} computed steps", float(count), int(count), float(one.mean()), _tail(one, np.ones_like(one)))
            for count, one in zip(self._counts, self._errors, strict=True)
        ]

    def mixed(self, evaluations: float) -> Row:
        """Two fixed schedules, taken at random, so that there are so many evaluations on average."""
        (low,), (share,) = self._between(np.array([evaluations]))
        errors = self._errors[[low, low + 1]]
        weights = np.repeat([[1 - share], [share]], errors.shape[1], 1)
        name = f"a fixed number, {evaluations:.2f} on average"
        most = int(self._counts[low + (share > 0)])
        return Row(name, evaluations, most, float(np.average(errors, weights=weights)), _tail(errors, weights))

    def row(self, name: str, table: Array, costs: Indices, shares: Array, rank: float | None = None) -> Row:
        """What calls gain over fixed schedules.

        Args:
            table: errors of all endings, ``[E, N]``.
            costs: evaluations with each, ``[E]``.
            shares: of each call, with which probability it gets which ending: ``[E, N]``.
        """
        errors, evaluations = (shares * table).sum(0), costs @ shares
        gains = self._gains(errors, evaluations)
        low, high = np.quantile(gains[1:], (0.025, 0.975))
        gain, most = (float(gains[0]), float(low), float(high)), int(costs[shares.any(1)].max())
        return Row(name, float(evaluations.mean()), most, float(errors.mean()), _tail(table, shares), gain, rank)

    def _gains(self, errors: Array, evaluations: Array) -> Array:
        """Of all calls once, and then of each sample of the episodes."""
        spent, lost = self._weights @ evaluations, self._weights @ errors
        low, share = self._between(spent)
        known, which = self._errors @ self._weights.T, np.arange(len(low))
        return 1 - lost / ((1 - share) * known[low, which] + share * known[low + 1, which])

    def _between(self, evaluations: Array) -> tuple[Indices, Array]:
        """Which of the schedules has fewer evaluations, and the share of the next one in the mixture."""
        low = np.searchsorted(self._counts, evaluations, "right").clip(1, len(self._counts) - 1) - 1
        share = (evaluations - self._counts[low]) / (self._counts[low + 1] - self._counts[low])
        return low, share.clip(0, 1)


def decided(family: Family, errors: Mapping[Steps, Array], estimates: tuple[Array, Array], fixed: Fixed) -> list[Row]:
    """What a family does on calls: decided by its estimate, by chance, and by who knows the errors.

    Args:
        errors: of its endings on these calls, ``[N]`` each.
        estimates: of the calls learned from, and of these.
    """
    table, costs = np.stack([errors[ending] for ending in family.endings]), np.array(family.costs)
    every = np.eye(len(costs))
    chosen = every[:, family.chosen(estimates[1], family.thresholds(estimates[0]))]
    chance = np.repeat(chosen.mean(1, keepdims=True), table.shape[1], 1)
    after = every[:, _after_the_fact(table, costs, float((costs @ chosen).mean()))]
    rank = rank_correlation(estimates[1], table[0])
    return [
        fixed.row("the estimate", table, costs, chosen, rank),
        fixed.row("chance", table, costs, chance),
        fixed.row("everything, after the fact", table, costs, after),
    ]


def _after_the_fact(errors: Array, costs: Indices, evaluations: float) -> Indices:
    """The best endings ``[N]`` that need at most so many evaluations on average: each has a price."""
    low, high = 0.0, float(np.ptp(errors)) + 1.0
    for _ in range(60):
        price = (low + high) / 2
        if costs[(errors + price * costs[:, None]).argmin(0)].mean() > evaluations:
            low = price
        else:
            high = price
    return np.asarray((errors + high * costs[:, None]).argmin(0), np.int64)


def rank_correlation(one: Array, other: Array) -> float:
    """Spearman's, of numbers without ties; 0 where there is nothing to tell."""
    if min(float(np.ptp(each)) for each in (one, other)) == 0:
        return 0.0
    first, second = (each.argsort().argsort() - (len(each) - 1) / 2 for each in (one, other))
    return float(first @ second / (first @ first))


def _tail(errors: Array, weights: Array) -> tuple[float, ...]:
    """The errors that 95 %, 99 % and all of weighted calls have at most; arrays of one shape."""
    order = errors.ravel().argsort()
    reached = np.cumsum(weights.ravel()[order]) / weights.sum()
    return tuple(float(errors.ravel()[order[np.searchsorted(reached, share - 1e-9)]]) for share in (0.95, 0.99, 1.0))
