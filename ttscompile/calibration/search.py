"""A strategy at work, interval by interval, as long as there is time."""

from __future__ import annotations

from collections.abc import Callable

from ..core.lattice import sparsity
from .clock import Clock
from .strategies import strategy_of
from .task import Found, Search, Task
from .trials import Trials


def open_search(name: str, task: Task) -> Search:
    """The search of the strategy of this name, ready to begin."""
    strategy, model = strategy_of(name), task.executor.model
    strategy.require_reach(model.steps, model.blocks, task.budget)
    return strategy.make()(task)


def search_plan(
    search: Search,
    clock: Clock,
    most: int | None = None,
    first: int = 0,
    after: Callable[[int, float], None] = lambda done, longest: None,
) -> tuple[Found, int, str]:
    """Intervals until the search is done, or the time is up; one at least.

    Args:
        search: after its first ``first`` intervals.
        most: intervals; None for the strategy's own number.
        first: the interval to begin with.
        after: told after each interval how many are done, and how many seconds the longest took.

    Returns:
        What was found, after how many intervals, and why it stopped: ``finished`` or ``time limit``.

    Raises:
        CalibrationFailedError: the time was up before there was a plan within the budget.
    """
    count = search.intervals if most is None else min(most, search.intervals)
    number, longest = first, 0.0
    while number < count and not search.done:
        start = clock.elapsed()
        if number > 0 and not clock.has(longest + search.settling):
            break
        search.advance(number)
        number += 1
        longest = max(longest, clock.elapsed() - start)
        after(number, longest)
    return search.found(), number, "time limit" if clock.cut else "finished"


def searched(
    trials: Trials, search: Search, clock: Clock, most: int | None, name: str = "search"
) -> tuple[Found, int, str]:
    """``search_plan`` from where the state is; saved after every interval, under a name."""
    state, bar, done_so_far = trials.state, trials.bar, f"{name} intervals"
    first = int(state.progress.get(done_so_far, 0))
    count = search.intervals if most is None else min(most, search.intervals)
    if first:
        with state.reading():
            search.restore(state.get(name))
    bar.stage(name, count, first)

    def save(done: int, longest: float) -> None:
        state.put(name, search.state())
        state.progress.update({done_so_far: done, "seconds": clock.elapsed()})
        state.save()
        left = min(clock.left(), (count - done) * longest)
        bar.update(done, f"error {search.loss:.4f}, sparsity {sparsity(search.plan):.2%}", left)

    return search_plan(search, clock, most, first, save)
