"""Means with intervals, over episodes that several policies ran on the same seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

RESAMPLES = 10_000
Values: TypeAlias = Sequence[float] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A mean and its 95 % bootstrap interval (percentiles over resampled episodes)."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3f} [{self.low:.3f}, {self.high:.3f}]"


def estimate(values: Values, seed: int = 0) -> Estimate:
    """Mean of one number an episode.

    Args:
        values: at least one.
        seed: of the resampling, so that the same episodes give the same interval.

    Returns:
        The estimate; of one value the interval has no width, and means nothing.
    """
    array = np.asarray(values, dtype=np.float64)
    picks = np.random.default_rng(seed).integers(0, len(array), size=(RESAMPLES, len(array)))
    low, high = np.percentile(array[picks].mean(axis=1), [2.5, 97.5])
    return Estimate(float(array.mean()), float(low), float(high))


def paired_difference(values: Values, baseline: Values, seed: int = 0) -> Estimate:
    """Mean of ``value - baseline``, episode by episode.

    Args:
        values: one an episode.
        baseline: of the same seeds, in the same order.
        seed: of the resampling.

    Returns:
        The estimate: negative where the baseline is better.
    """
    differences = [value - base for value, base in zip(values, baseline, strict=True)]
    return estimate(differences, seed)
