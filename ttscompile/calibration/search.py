"""A strategy, interval by interval, as long as there is time."""

from __future__ import annotations

from ..lattice import sparsity
from .clock import Clock
from .progress import Bar
from .state import StateFile
from .strategies import Found, Strategy

CLOSING_SHARE = 0.3
"""What a strategy does at the end is left out where it would take more than this share of the time: on Push-T an
interval of search lowers the error by 3 to 30 %, the switches by a few."""


def search_plan(search: Strategy, state: StateFile, clock: Clock, bar: Bar, most: int | None) -> tuple[Found, int, str]:
    """Intervals until the strategy is done, or the time is up.

    Args:
        search: at its beginning.
        state: to go on from, and to save to after every interval.
        clock: with the limit of the search.
        bar: shows the progress.
        most: intervals; None for the strategy's own number.

    Returns:
        What was found, after how many intervals, and why it stopped.
    """
    count = search.intervals if most is None else min(most, search.intervals)
    first = int(state.progress.get("intervals", 0))
    if first:
        with state.reading():
            search.restore(state.get("strategy"))
    bar.stage("search", count, first)
    number, longest, cut = first, 0.0, False
    while number < count and not search.done:
        start = clock.elapsed()
        end = start + longest + search.settling
        if number > 0 and end > clock.limit:
            return search.found(), number, "time limit"
        closing = search.closing * longest
        if number > 0 and closing <= CLOSING_SHARE * clock.limit and end + closing > clock.limit:
            search.close()
            cut = True
        search.advance(number)
        number += 1
        longest = max(longest, clock.elapsed() - start)
        state.put("strategy", search.state())
        state.progress.update(intervals=number, seconds=clock.elapsed())
        state.save()
        left = min(clock.left(), (count - number) * longest)
        bar.update(number, f"error {search.loss:.4f}, sparsity {sparsity(search.plan):.2%}", left)
    return search.found(), number, "time limit" if cut else "converged" if search.done else "finished"
