"""Seconds of work, and what there is still time for."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from copy import copy
from typing import TypeVar

Part = TypeVar("Part")


class Clock:
    """Seconds of work, those before an interruption included, and what there is still time for.

    Args:
        limit: seconds after which nothing more is begun.
        before: seconds of the parts of the work before this one.
        begun: reading of ``time.monotonic`` when this part began; None for now.

    Attributes:
        cut: whether anything was left out for want of time.
    """

    def __init__(self, limit: float = math.inf, before: float = 0.0, begun: float | None = None) -> None:
        self.limit, self.cut = limit, False
        self._zero = (time.monotonic() if begun is None else begun) - before

    def elapsed(self) -> float:
        """Seconds of work so far."""
        return time.monotonic() - self._zero

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
