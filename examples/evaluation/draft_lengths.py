"""How many steps to draft next: as many as ever, as the last round says, as the step says, or as will be taken.

``drafted.py`` measures with it what a scheduler such as TS-DP's can gain (arXiv 2512.15773). Theirs learns from
rewards; here are two that need none, and one that knows what will be taken, which bounds what any of them gains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Place:
    """Before a round of drafts.

    Attributes:
        step: the next one, of which the sample is known.
        asked: how many steps the round before was to check; 0 before any.
        gone: by how many it went on.
        peek: how many steps a round would go on that checks so many.
    """

    step: int
    asked: int
    gone: int
    peek: Callable[[int], int]


Ahead = Callable[[Place], int]
"""How many steps the next round checks."""


def fixed(count: int) -> Ahead:
    """Always so many."""
    return lambda place: count


def after_the_last(most: int) -> Ahead:
    """Twice as many as in the last round, if that took all of them; otherwise one more than it took."""

    def ahead(place: Place) -> int:
        if not place.asked:
            return max(2, most // 2)
        return min(most, 2 * place.asked if place.gone == place.asked else place.gone + 1)

    return ahead


def that_will_be_taken(most: int) -> Ahead:
    """As many as the round goes on with: so nothing is checked in vain."""
    return lambda place: place.peek(most)


def by_step(gone: Mapping[int, Sequence[int]], seconds: Mapping[int, float]) -> Ahead:
    """As many as go on by most steps a second from this step on, by the rounds of other calls.

    Args:
        gone: by step, how far rounds of as many steps as can be went on that began there.
        seconds: of a round, by how many steps it checks: of 1 and of the most at least.
    """
    counts = np.arange(1, max(seconds) + 1)
    cost = np.interp(counts, sorted(seconds), [seconds[count] for count in sorted(seconds)])
    known = np.array(sorted(gone))
    pace = {k: np.minimum(np.array(gone[k])[:, None], counts).mean(0) / cost for k in gone}
    best = {k: int(counts[np.argmax(own)]) for k, own in pace.items()}

    def ahead(place: Place) -> int:
        return best[int(known[np.argmin(abs(known - place.step))])]

    return ahead
