"""Seconds of work, and what there is still time for.

Work is what the process was given of the processors, so that a plan does not depend on what else the machine does: a
second is one in which all of torch's threads computed. Where the machine is busy, such a second takes longer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from typing import TypeVar

import torch

Part = TypeVar("Part")

SLOWEST = 2.0
"""Seconds by the wall clock that a second of work takes at most: beyond, the machine's speed does decide. On many cores
some work is for one thread, which would hardly count."""


class Clock:
    """Seconds of work, those before an interruption included, and what there is still time for.

    Args:
        limit: seconds after which nothing more is begun.
        before: seconds of the parts of the work before this one.
        wall: whether seconds are those of the wall clock, because the work is done by other processes or a device.

    Attributes:
        left_out: what was left out for want of time. Clocks that are made of one share this and the following.
        ahead: give the seconds that what has to follow takes.
        paces: how many times as long a judgement took, at most, as its calls would alone; of plans in fp32, False, and
            of those in another precision, True, whose calls are computed one by one.
    """

    def __init__(self, limit: float = math.inf, before: float = 0.0, wall: bool = False) -> None:
        self.limit, self._end, self._before = limit, limit, before
        self.left_out, self.ahead = list[str](), list[Callable[[], float]]()
        self.paces = dict[bool, float]()
        self._threads = 0 if wall else torch.get_num_threads()
        self._begun = time.monotonic(), time.process_time()

    def elapsed(self) -> float:
        """Seconds of work so far."""
        wall, work = time.monotonic() - self._begun[0], time.process_time() - self._begun[1]
        return self._before + (min(wall, max(work / self._threads, wall / SLOWEST)) if self._threads else wall)

    def left(self) -> float:
        """Seconds until the limit, or until what has to follow must begin; negative after that."""
        return min(self.limit, self._end - sum(one() for one in self.ahead)) - self.elapsed()

    def until(self, share: float) -> Clock:
        """The same clock with a share of the limit."""
        other = copy(self)
        other.limit *= share
        return other

    def has(self, seconds: float, what: str = "a longer search") -> bool:
        """Whether so much is left; else ``what`` is left out."""
        enough = seconds <= self.left()
        if not enough and what not in self.left_out:
            self.left_out.append(what)
        return enough

    def in_time(self, parts: Iterable[Part]) -> Iterator[Part]:
        """The first part of some work, and others as long as they end in time, taking no more than those before."""
        longest = 0.0
        for number, part in enumerate(parts):
            begun = self.elapsed()
            if number and not self.has(longest):
                return
            yield part
            longest = max(longest, self.elapsed() - begun)
