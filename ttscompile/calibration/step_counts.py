"""How many steps a plan computes, and where in the loop: evenly, or crowded towards one of its ends.

As many as an error allows; twice and half as many for the plans beside the target.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationFailedError
from .budget import Goal
from .clock import Clock
from .progress import Bar
from .proposer import ScheduleRow
from .state import StateFile
from .task import Found, Task
from .whole_steps import Errors, WholeSteps

CROWDING = (3.0, 2.0, 4.0, 1.5, 1.0, 2.5, 3.5, 5.0, 0.6, 0.4)
"""1 is even, above it the steps crowd towards the end, below it towards the start. In the order in which they are
tried, since time may end the search: late steps mattered most wherever it was measured. Of 3 steps among 16 the first
is 0, 11, 15, with a third less error on Push-T than 0, 8, 14, which 2.0 is."""

MOST_PLACEMENTS = 128
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
    """All other schedules of ``full_steps`` of the steps, step 0 among them; None for over ``MOST_PLACEMENTS``."""
    if comb(steps - 1, full_steps - 1) > MOST_PLACEMENTS:
        return None
    every = ((0, *rest) for rest in combinations(range(1, steps), full_steps - 1))
    return sorted(set(every) - set(spacings(steps, full_steps)), reverse=True)  # late steps first, see CROWDING


COUNTS = (1, 2, 3, 4, 5, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Numbers of computed steps that an error budget is tried with, before bisection between two of them."""

FEWER_CROWDINGS = (1.0, 2.0, 3.0, 4.0)
"""Those of ``CROWDING`` that are tried while only the number of steps is in question."""

SAFE, FAST = "safe", "fast"
"""Plans beside the target: one computes twice as many cells, the other half as many; the robot chooses."""

BESIDE_SHARE = 0.2
"""Share of the time limit that is kept from the search for these plans."""


class Best(NamedTuple):
    """The best schedule of a family, and its error on calls that its correction was not fitted on, in units."""

    steps: tuple[int, ...]
    error: float


class SpacedSchedules:
    """Compares crowded schedules, and remembers every comparison in the state, under ``key``.

    Nothing is begun that would end, with the correction and the judgement that follow, after the clock's limit.
    """

    def __init__(self, whole: WholeSteps, state: StateFile, clock: Clock, bar: Bar, key: str = "crowded") -> None:
        self._whole, self._state, self._clock, self._bar, self._key = whole, state, clock, bar, key

    def best(self, full_steps: int, what: str, crowding: Sequence[float] = CROWDING) -> Best | None:
        """The best of the family of ``full_steps`` computed steps, of those that there was time for; or None."""
        found: tuple[Errors, tuple[int, ...]] | None = None
        members = spacings(self._whole.steps, full_steps, crowding)
        self._bar.stage(what, len(members))
        for number, steps in enumerate(members):
            errors = self._errors(steps, members[number:], what)
            if errors is None:
                break
            if found is None or errors.normalised < found[0].normalised:
                found = errors, steps
            self._bar.update(number + 1, f"error {found[0].units:.4g}", self._clock.left())
        return None if found is None else Best(found[1], found[0].units)

    def _errors(self, steps: tuple[int, ...], coming: Sequence[tuple[int, ...]], what: str) -> Errors | None:
        """The errors of a schedule, the first of those that are coming; None if not known and there is no time."""
        known = self._state.progress.setdefault(self._key, {})
        key = ",".join(map(str, steps))
        if key not in known:
            # All plans together are judged on fewer calls than one is compared on: that takes no longer.
            if not self._clock.has(2 * self._whole.comparing(len(steps)) + self._whole.correcting(len(steps)), what):
                return None
            self._whole.expect(coming)
            errors = self._whole.errors(steps)
            known[key] = [errors.normalised, errors.units]
            self._state.save(seconds=self._clock.elapsed())
        with self._state.reading():
            normalised, units = known[key]
            return Errors(float(normalised), float(units))


def budget_of_error(crowded: SpacedSchedules, goal: Goal, steps: int, blocks: int) -> Goal:
    """The goal with the fewest whole steps with which a crowded schedule is as good as was asked for.

    Judged on calls to learn from that its correction was not fitted on: the held-out episodes stay out of it. The goal
    is of kind ``max_action_error``.

    Raises:
        CalibrationFailedError: no plan that reuses at least half of the cells is, or the time is up before one is.
    """
    tried: dict[int, float] = {}

    def failed(what: str, otherwise: str) -> CalibrationFailedError:
        told = [f"{error:.4g} with {full} of the steps computed" for full, error in tried.items()] or ["none tried"]
        return CalibrationFailedError(f"{what}: {', '.join(told)}. The artifact is as it was. {otherwise}.")

    def enough(full: int) -> bool:
        best = crowded.best(full, f"{full} steps", FEWER_CROWDINGS)
        if best is None:
            what = f"the time limit ended the search for a plan with an action error of at most {goal.value:g}"
            raise failed(what, "Allow more time, or a larger error")
        tried[full] = best.error
        return tried[full] <= goal.value

    most, low = max(1, steps // 2), 0
    for high in [count for count in COUNTS if count < most] + [most]:
        if enough(high):
            break
        low = high
    else:
        what = f"max action error {goal.value:g} cannot be reached by a plan that reuses at least half of the cells"
        raise failed(what, "Allow a larger error, or use the dense plan")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    errors = {str(n): error for n, error in sorted(tried.items())}
    return replace(goal, cells=high * blocks, measured={"errors": errors})


def plans_beside(
    crowded: SpacedSchedules, task: Task, row: ScheduleRow, cells: int
) -> tuple[dict[str, Found], dict[str, str]]:
    """Make ``safe`` and ``fast``, where they can be made: whole steps with a correction fitted on all calls.

    The search of ``row`` found the target's plan, which computes ``cells``.
    """
    steps, target = task.runner.model.steps, max(1, cells // task.runner.model.blocks)
    plans: dict[str, Found] = {}
    skipped: dict[str, str] = {}
    if not row.corrects:
        return plans, dict.fromkeys((SAFE, FAST), f"needs a correction: {row.name!r} fits none")
    if 2 * target >= steps:
        skipped[SAFE] = f"would be the dense plan: twice {target} of {steps} steps"
    if target <= 2:
        skipped[FAST] = f"would compute too little: half of the target's {target} whole step{'s' * (target > 1)}"
    for name, count in ((SAFE, 2 * target), (FAST, max(2, target // 2))):
        if name in skipped:
            continue
        if (best := crowded.best(count, f"plan {name}")) is None:
            skipped[name] = "found no time within the limit"
        else:
            plans[name] = task.whole_steps(best.steps)
    return plans, skipped
