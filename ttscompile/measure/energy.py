"""The energy distance (Szekely and Rizzo, 2013) between what a plan and the original answer: ``calibration.judge``."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

Numbers = npt.NDArray[np.float64]

SAME, TENTH = 1e-4, 0.1
"""Of what another observation changes: less is rounding; and the unit of distances where noise changes no more."""


def pairs(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """h, and how far two answers of the original are apart, mean over the pairs of draws of each call.

    Where noise changes nothing: the square of how far the plan is off, and that of a ``TENTH`` of how far answers to
    two observations are apart (of 1, where there is one), of which ``rooted`` makes a root mean square in this unit.

    Args:
        x: what a plan answers, ``[N, R, A]``.
        y: what the original answers.

    Returns:
        ``[N]`` twice.
    """
    found = []
    for i, j in combinations(range(x.shape[1]), 2):
        crossed = _far(x[:, i], y[:, j]) + _far(x[:, j], y[:, i])
        apart = _far(y[:, i], y[:, j])
        found.append((crossed - _far(x[:, i], x[:, j]) - apart, apart))
    h, far = np.mean(found, axis=0)
    observed = np.mean([_far(y[:, 0], np.roll(y[:, 0], n, 0)).mean() for n in range(1, min(len(y), 33))] or [1.0])
    if far.mean() > SAME * observed:
        return h, far
    return np.square(_far(x, y)).mean(1), np.full(len(x), (TENTH * observed) ** 2)


def _far(one: Numbers, other: Numbers) -> Numbers:
    return np.asarray(np.sqrt(np.square(one - other).mean(-1)))


def rooted(gap: float, apart: float) -> float:
    """The root of a mean h in units of how far answers of the original are apart; of less than 0 that of its size."""
    share = gap / max(apart, 1e-12)
    return float(np.sign(share) * np.sqrt(abs(share)))
