"""Means and shares with intervals, over episodes that several policies ran on the same seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

RESAMPLES, PORTION = 10_000, 500
"""How often episodes are drawn anew, and how many of these are held at once."""
LEVEL = 0.95
Values: TypeAlias = Sequence[float] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A mean and its interval, of 95 % unless something else was asked for."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3f} [{self.low:.3f}, {self.high:.3f}]"


def estimate(values: Values, seed: int = 0, level: float = LEVEL) -> Estimate:
    """Mean of one number an episode, with its bootstrap interval (percentiles over resampled episodes).

    Args:
        values: at least one.
        seed: of the resampling, so that the same episodes give the same interval.
        level: of the interval.

    Returns:
        The estimate; of one value the interval has no width, and means nothing.
    """
    array = np.asarray(values, dtype=np.float64)
    rng, means = np.random.default_rng(seed), np.empty(RESAMPLES)
    for start in range(0, RESAMPLES, PORTION):
        part = means[start : start + PORTION]
        part[:] = array[rng.integers(0, len(array), size=(len(part), len(array)))].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(array.mean()), float(low), float(high))


def paired_difference(values: Values, baseline: Values, seed: int = 0, level: float = LEVEL) -> Estimate:
    """Mean of ``value - baseline``, episode by episode.

    Args:
        values: one an episode.
        baseline: of the same seeds, in the same order.
        seed: of the resampling.
        level: of the interval.

    Returns:
        The estimate: negative where the baseline is better.
    """
    differences = [value - base for value, base in zip(values, baseline, strict=True)]
    return estimate(differences, seed, level)


def share(values: Values, level: float = LEVEL) -> Estimate:
    """Share of ones, with Wilson's interval, which is right near 0 and 1, too (Wilson 1927).

    Args:
        values: 0 or 1, at least one.
        level: of the interval.

    Returns:
        The estimate. Even of one value the interval has a width.
    """
    count, mean = len(values), float(np.mean(np.asarray(values, dtype=np.float64)))
    z = NormalDist().inv_cdf((1 + level) / 2)
    centre, shrunk = mean + z * z / (2 * count), 1 + z * z / count
    half = z * math.sqrt(mean * (1 - mean) / count + (z / (2 * count)) ** 2)
    # The ends are 0 and 1 exactly where nothing or all is a one; rounding may leave them beside.
    low, high = max((centre - half) / shrunk, 0.0), min((centre + half) / shrunk, 1.0)
    return Estimate(mean, min(low, mean), max(high, mean))


def paired_difference_of_shares(values: Values, baseline: Values, level: float = LEVEL) -> Estimate:
    """Difference of two shares of the same episodes, with Newcombe's interval (1998, method 10).

    It is made of the two Wilson intervals and the correlation of the pairs, and so has a width where no pair differs.

    Args:
        values: 0 or 1, one an episode.
        baseline: of the same seeds, in the same order.
        level: of the interval.

    Returns:
        The estimate: negative where the baseline is better.
    """
    pairs = np.array(list(zip(values, baseline, strict=True)), dtype=np.float64)
    one, other = share(pairs[:, 0], level), share(pairs[:, 1], level)
    alike = _correlation(pairs)

    def reach(own: float, base: float) -> float:
        return math.sqrt(max(own * own - 2 * alike * own * base + base * base, 0.0))

    mean = one.mean - other.mean
    low = mean - reach(one.mean - one.low, other.high - other.mean)
    return Estimate(mean, low, mean + reach(one.high - one.mean, other.mean - other.low))


def _correlation(pairs: npt.NDArray[np.float64]) -> float:
    """Of two columns of zeros and ones, with Newcombe's correction for continuity; 0 where one of them is constant."""
    both = float((pairs[:, 0] * pairs[:, 1]).sum())
    none = float(((1 - pairs[:, 0]) * (1 - pairs[:, 1])).sum())
    first = float((pairs[:, 0] * (1 - pairs[:, 1])).sum())
    second = float(((1 - pairs[:, 0]) * pairs[:, 1]).sum())
    margins = (both + first) * (second + none) * (both + second) * (first + none)
    if margins == 0:
        return 0.0
    product = both * none - first * second
    if product > 0:
        product = max(product - len(pairs) / 2, 0.0)
    return product / math.sqrt(margins)
