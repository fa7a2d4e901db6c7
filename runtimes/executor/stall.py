"""A watchdog for a policy that has stopped moving. No clock, no threads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ttscompile.core.spec import FloatArray


@dataclass(frozen=True)
class StallRule:
    """When a policy has stopped moving, and what is done about it; see ``ExecutorSettings.stall_after``.

    Attributes:
        ticks: for which the actions have to stay where they are.
        reach: float32 ``[Da]``, how far from the first of them they may be, in their own units.
        plan: that the next call runs then.
        summed: channels that are displacements: what they add up to says where the robot is.
    """

    ticks: int
    reach: FloatArray
    plan: str
    summed: tuple[int, ...] = ()


class Watchdog:
    """Looks at the actions of one episode; a rule of None never finds anything."""

    def __init__(self, rule: StallRule | None) -> None:
        self._rule, self._sum = rule, np.zeros(0 if rule is None else len(rule.reach), np.float32)
        self.restart()

    def restart(self) -> None:
        """Look at the actions from here on alone."""
        self._first: FloatArray | None = None
        self._still = 0  # ticks after the first

    @property
    def plan(self) -> str | None:
        """The plan that the next call shall run, because the actions have stopped moving; None if they have not."""
        return None if self._rule is None or self._still < self._rule.ticks else self._rule.plan

    def give(self, action: FloatArray) -> bool:
        """Take note that an action ``[Da]`` was given out; whether ``plan`` is another one now."""
        if self._rule is None:
            return False
        before, summed = self.plan, list(self._rule.summed)
        self._sum = self._sum + action
        action = action.copy()
        action[summed] = self._sum[summed]
        if self._first is not None and (np.abs(action - self._first) <= self._rule.reach).all():
            self._still += 1
        else:
            self._first, self._still = action, 0
        return self.plan != before
