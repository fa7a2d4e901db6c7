"""A strategy, interval by interval, as long as there is time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from .clock import Clock

if TYPE_CHECKING:
    from .strategies.base import Found, Strategy

CLOSING_SHARE = 0.3
"""What a strategy does at the end is left out where it would take more than this share of the time: on Push-T an
interval of search lowers the error by 3 to 30 %, the switches by a few."""


def search_plan(
    search: Strategy,
    clock: Clock,
    most: int | None = None,
    first: int = 0,
    after: Callable[[int, float], None] = lambda done, longest: None,
) -> tuple[Found, int, str]:
    """Intervals until the strategy is done, or the time is up; one at least.

    Args:
        search: after its first ``first`` intervals.
        clock: with the limit of the search.
        most: intervals; None for the strategy's own number.
        first: the interval to begin with.
        after: told after each interval how many are done, and how many seconds the longest took.

    Returns:
        What was found, after how many intervals, and why it stopped: ``converged``, ``finished`` or ``time limit``.

    Raises:
        CalibrationFailedError: the time was up before there was a plan within the budget.
    """
    count = search.intervals if most is None else min(most, search.intervals)
    number, longest = first, 0.0
    while number < count and not search.done:
        start = clock.elapsed()
        if number > 0 and not clock.has(longest + search.settling):
            break
        closing = search.closing * longest
        if 0 < closing <= CLOSING_SHARE * clock.limit and not clock.has(longest + search.settling + closing):
            search.close()
        search.advance(number)
        number += 1
        longest = max(longest, clock.elapsed() - start)
        after(number, longest)
    return search.found(), number, "time limit" if clock.cut else "converged" if search.done else "finished"
