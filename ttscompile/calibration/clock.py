"""Seconds of work, and what there is still time for.

Work is what the process was given of the processors, so that a plan does not depend on what else the machine does: a
second is one in which all of torch's threads computed. Where the machine is busy, such a second takes longer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
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
        cut: whether anything was left out for want of time.
    """

    def __init__(self, limit: float = math.inf, before: float = 0.0, wall: bool = False) -> None:
        self.limit, self.cut, self._before = limit, False, before
        self._threads = 0 if wall else torch.get_num_threads()
        self._begun = time.monotonic(), time.process_time()

    def elapsed(self) -> float:
        """Seconds of work so far."""
        wall, work = time.monotonic() - self._begun[0], time.process_time() - self._begun[1]
        return self._before + (min(wall, max(work / self._threads, wall / SLOWEST)) if self._threads else wall)

    def left(self) -> float:
        """Seconds until the limit; negative after it."""
        return self.limit - self.elapsed()

    def until(self, share: float) -> Clock:
        """The same clock with a share of the limit."""
        other = copy(self)
        other.limit *= share
        return other

    def has(self, seconds: float) -> bool:
        """Whether so much is left; where it is not, something is left out, and ``cut`` says so."""
        enough = seconds <= self.left()
        self.cut |= not enough
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
