"""Where computed steps are placed in the loop: evenly, or crowded towards one of its ends.

Late steps mattered most wherever it was measured, so that is tried first.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import comb

import numpy as np

CROWDING = (3.0, 2.0, 4.0, 1.5, 1.0, 2.5, 3.5, 5.0, 0.6, 0.4)
"""1 is even, above it the steps crowd towards the end, below it towards the start. In the order in which they are
tried, since time may end the search: late steps mattered most wherever it was measured. Of 3 steps among 16 the first
is 0, 11, 15, with a third less error on Push-T than 0, 8, 14, which 2.0 is."""

FEW = 128
"""Where there are no more placements, a search tries them all: those of three steps among 16 are 105."""


def spaced_steps(steps: int, full_steps: int, crowding: float) -> tuple[int, ...]:
    """Which steps to compute, in order: the i-th of m is at ``K * (1 - (1 - i/m) ** crowding)``, the first at 0."""
    wished = steps * (1 - (1 - np.arange(full_steps) / full_steps) ** crowding)
    chosen: list[int] = []
    for i, wish in enumerate(wished):  # distinct, in order, and leaving room for those that follow
        earliest = chosen[-1] + 1 if chosen else 0
        chosen.append(int(np.clip(np.floor(wish), earliest, steps - full_steps + i)))
    return tuple(chosen)


def spacings(steps: int, full_steps: int, crowding: Sequence[float] = CROWDING) -> list[tuple[int, ...]]:
    """The different schedules that compute ``full_steps`` of the steps."""
    return list(dict.fromkeys(spaced_steps(steps, full_steps, one) for one in crowding))


def other_placements(steps: int, full_steps: int) -> list[tuple[int, ...]] | None:
    """All other schedules of ``full_steps`` of the steps, step 0 among them; None if there are more than ``FEW``."""
    if comb(steps - 1, full_steps - 1) > FEW:
        return None
    every = ((0, *rest) for rest in combinations(range(1, steps), full_steps - 1))
    return sorted(set(every) - set(spacings(steps, full_steps)), reverse=True)  # late steps first, see CROWDING
