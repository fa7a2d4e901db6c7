"""Budgets at equal milliseconds: how many cells a proposer may compute whose calls take as long as others'.

A cell costs more where a step has few of them: five whole steps are faster than as many cells that are spread over a
hundred steps. So plans of as many cells do not take the same time. Here every plan takes its turn with one of evenly
spaced whole steps, which is as fast as plans of so many cells get, and its budget is made smaller until it is as fast.
What else the machine does hits both, so that budgets that were found hours apart mean the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

from ttscompile.calibration.budget import goal_of, measure_budget
from ttscompile.calibration.judge import timed
from ttscompile.calibration.trials import HELD_OUT, Trials
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import Plan

SLACK = 0.05
"""Shares of equal plans differ by as much: one that is within so much of 1 keeps the pace, and is near enough to it."""

OPENED = 2
"""How often a plan and the even steps are opened: where arrays happen to be makes the same plan faster or slower."""

FEWEST, MOST, SECONDS = 10, 400, 4.0
"""Rounds in which they take turns, at least and at most, and about how long all of these take."""

TRIES = 5
"""Budgets that are tried, at most."""


@dataclass(frozen=True)
class Pace:
    """How long a call may take: as long as one of evenly spaced whole steps.

    Attributes:
        steps: how many.
        threads: of the timed calls.
        name: of the plans that keep it.
    """

    trials: Trials
    steps: int
    threads: int
    name: str

    @property
    def cells(self) -> int:
        """That these steps have: no plan of more is as fast."""
        return self.steps * len(self.trials.runner.view.manifest.blocks)

    def share(self, plan: Plan) -> float:
        """What a call of a plan takes, as a share of that: the median of rounds in which the two take turns."""
        self.trials.sample(HELD_OUT)
        cells = uniform_plan(self.trials.runner.view.manifest.steps, self.cells // self.steps, self.steps)
        given = (self.trials, plan), (self.trials, replace(self.trials.base, cells=cells))
        once = sum(one.median for one in timed(given, self.threads, FEWEST)) / 1000
        times = timed(given * OPENED, self.threads, max(FEWEST, min(MOST, round(SECONDS / OPENED / once))))
        pairs = zip(times[::2], times[1::2], strict=True)
        return median(one / even for pair in pairs for one, even in zip(*(each.ms for each in pair), strict=True))


def pace_of(trials: Trials, latency_ms: float, threads: int) -> Pace:
    """As many steps as a call of so many milliseconds has room for, on this machine.

    Raises:
        CalibrationError: step 0 alone takes longer, or all steps do not.
    """
    goal = measure_budget(trials, goal_of(latency_ms=latency_ms, threads=threads), False)
    return Pace(trials, goal.cells // len(trials.runner.view.manifest.blocks), threads, f"{latency_ms:g}ms")


def largest(share: Callable[[int], float], least: int, most: int, near: int) -> tuple[int | None, dict[int, float]]:
    """The largest budget whose plan keeps the pace, as far as ``TRIES`` tell.

    Bisection, but of the two budgets between which it is each time, that is tried next where a line through their times
    keeps the pace; not in the middle, since a search may take minutes.

    Args:
        share: of the pace that the plan of a budget takes.
        least: a budget below which there is no plan.
        most: the one to begin with.
        near: two budgets that differ by no more are alike.

    Returns:
        The budget, None where none was found, and of each that was tried its share of the pace.
    """
    tried = dict[int, float]()
    low, high, cells = least, most, most
    while len(tried) < TRIES and cells not in tried:
        tried[cells] = share(cells)
        if tried[cells] <= 1 + SLACK:
            low = cells
        else:
            high = cells
        if abs(tried[cells] - 1) <= SLACK or (high - low <= near and low in tried):
            break
        if low in tried:
            steep = (tried[high] - tried[low]) / (high - low)
            cells = low + round((1 - tried[low]) / steep) if steep > 0 else (low + high) // 2
        else:  # shorter calls are faster by less than they are shorter, since a call has costs that no cell has
            cells = round(high / tried[high] ** 2)
        cells = max(least, min(cells, high - near), low + near if low in tried else least)
    kept = [one for one, took in tried.items() if took <= 1 + SLACK]
    return max(kept, default=None), tried
