"""The one timer: candidates take turns, so that whatever else the machine does hits all of them alike."""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median, quantiles
from time import perf_counter
from typing import TypeVar

Result = TypeVar("Result")

MANY = 100
"""Calls from which on their 99th percentile is told in place of the longest."""


@dataclass(frozen=True)
class Times:
    """Wall times of the counted calls of one candidate.

    Attributes:
        ms: milliseconds of each call, in order; at least one.
    """

    ms: tuple[float, ...]

    @property
    def median(self) -> float:
        """Milliseconds a call."""
        return float(median(self.ms))

    @property
    def worst(self) -> float:
        """What 99 of 100 calls take at most, in milliseconds; of fewer than ``MANY`` calls all."""
        return max(self.ms) if len(self.ms) < MANY else quantiles(self.ms, n=100, method="inclusive")[98]

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile in milliseconds, interpolated as numpy's percentiles are."""
        if len(self.ms) == 1:
            return self.ms[0], self.ms[0]
        low, _, high = quantiles(self.ms, n=4, method="inclusive")
        return low, high


class Timer:
    """Times candidates in rounds, in each of which every candidate is called once.

    The caller writes the loop, so that what is not to be timed stands outside of ``time``::

        timer = Timer(len(calls), warm_up=2)
        for _ in range(2 + runs):
            for i in timer.round():
                timer.time(i, calls[i])
        medians = [one.median for one in timer.times]

    Args:
        warm_up: rounds at the start whose times do not count.
        clock: seconds since some fixed moment; tests move it.
    """

    def __init__(self, candidates: int, warm_up: int, clock: Callable[[], float] = perf_counter) -> None:
        self._ms: list[list[float]] = [[] for _ in range(candidates)]
        self._warm_up, self._clock, self._begun = warm_up, clock, 0

    def round(self) -> list[int]:
        """Begin a round: the candidates in its order, in which nobody always runs after the same one."""
        count = len(self._ms)
        first = self._begun % count
        self._begun += 1
        return [(first + turn) % count for turn in range(count)]

    @property
    def counted(self) -> int:
        """Rounds whose times count, the one under way included; 0 during warm-up."""
        return max(self._begun - self._warm_up, 0)

    def time(self, candidate: int, call: Callable[[], Result]) -> Result:
        """Time one call of a candidate, and return what it returns."""
        start = self._clock()
        result = call()
        milliseconds = 1e3 * (self._clock() - start)
        if self.counted:
            self._ms[candidate].append(milliseconds)
        return result

    @property
    def times(self) -> list[Times]:
        """What the counted calls of each candidate took."""
        return [Times(tuple(ms)) for ms in self._ms]
