"""Seconds of work, those before an interruption included."""

from __future__ import annotations

import time


class Clock:
    """Counts from ``begun``.

    Args:
        begun: reading of ``time.monotonic`` when this part of the work began.
        before: seconds of the parts before it.
        limit: seconds after which nothing more is begun.
    """

    def __init__(self, begun: float, before: float, limit: float) -> None:
        self._begun, self._before, self.limit = begun, before, limit

    def elapsed(self) -> float:
        """Seconds so far."""
        return time.monotonic() - self._begun + self._before

    def left(self) -> float:
        """Seconds until the limit; negative after it."""
        return self.limit - self.elapsed()

    def until(self, share: float) -> Clock:
        """The same clock with a share of the limit."""
        return Clock(self._begun, self._before, self.limit * share)
