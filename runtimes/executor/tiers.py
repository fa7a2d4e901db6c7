"""Plans to fall back to when deadlines are missed, and the way back up. No clock, no threads."""

from __future__ import annotations

from collections.abc import Sequence

MOST_PATIENCE = 32
"""Times ``up_after`` that a tier which failed again and again has to wait at most."""


class Tiers:
    """Which plan the next call runs.

    A tier is left downwards after ``down_after`` missed deadlines in a row, and upwards after ``up_after`` calls in
    time. A tier that fails soon after it was tried again has to wait twice as long before the next try, so that a load
    which stays does not cost a missed deadline every ``up_after`` calls.

    Args:
        plans: names, slowest first.
        down_after: missed deadlines in a row that lead to the next faster plan.
        up_after: calls in time, in a row, that lead back.
    """

    def __init__(self, plans: Sequence[str], down_after: int, up_after: int) -> None:
        self.plans = tuple(plans)
        self._down_after, self._up_after = down_after, up_after
        self._current = 0
        self._missed, self._in_time = 0, 0
        self._patience = 1
        self._climbed = False

    @property
    def plan(self) -> str:
        """Name of the plan that the next call runs."""
        return self.plans[self._current]

    def after_call(self, missed: bool) -> int:
        """Take note of a call.

        Args:
            missed: it was not done in time.

        Returns:
            1 if this leads to a faster plan, -1 if back to a slower one, else 0.
        """
        if missed:
            self._missed, self._in_time = self._missed + 1, 0
            if self._missed < self._down_after or self._current == len(self.plans) - 1:
                return 0
            if self._climbed:
                self._patience = min(2 * self._patience, MOST_PATIENCE)
            self._move(1)
            self._climbed = False
            return 1
        self._missed, self._in_time = 0, self._in_time + 1
        if self._climbed and self._in_time >= self._up_after:
            self._climbed, self._patience = False, 1  # it holds: forget that it once failed
        if self._current == 0 or self._in_time < self._up_after * self._patience:
            return 0
        self._move(-1)
        self._climbed = True
        return -1

    def _move(self, by: int) -> None:
        self._current += by
        self._missed, self._in_time = 0, 0
