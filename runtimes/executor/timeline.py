"""What is played when: actions by control tick, and how a new chunk joins what is scheduled. No clock, no threads.

Time is cut into control ticks. A tick is *consumed* when its action has been given out; a new chunk starts to count at
the first tick that is not, however long its inference took::

    tick        10   11   12   13   14   15   16   17
    scheduled    a    a    a    a    a                      chunk a, observed at tick 8
    consumed     x    x    x                                given out while b was computed
    chunk b      .    .    .    b    b    b    b    b       observed at tick 10: its first three actions are overdue
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import FloatArray

FOLLOW = 0.05
"""Share of its distance from the middle of a tick by which each action moves the grid."""


class TickGrid:
    """From seconds to control ticks and back.

    The first observation of an episode says where tick 0 is. The first action that is given out moves the grid by less
    than half a tick, so that the control loop stands in the middle of its ticks and its jitter skips none; those after
    it move it a little, so that a loop whose rate is not exactly what was declared stays there. A rate that is more
    than ``FOLLOW / 2`` off is not followed: then ticks are skipped, or asked for twice, to stay with the time.
    """

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._origin: float | None = None
        self._anchored = False

    def tick(self, time: float) -> int:
        """The nearest tick; makes this time tick 0 if there is none."""
        if self._origin is None:
            self._origin = time
        return floor((time - self._origin) * self._hz + 0.5)

    def follow(self, time: float, tick: int) -> None:
        """Take note that the action of a tick was given out for a time."""
        off = time - self.time(tick)
        assert self._origin is not None  # ``time`` says so
        self._origin += FOLLOW * off if self._anchored else off
        self._anchored = True

    def time(self, tick: int) -> float:
        """Seconds of a tick; there must be a tick 0."""
        assert self._origin is not None  # callers have made a tick of a time
        return self._origin + tick / self._hz


@dataclass(frozen=True)
class Timeline:
    """Scheduled actions.

    Attributes:
        start: tick of the first row.
        rows: float32 ``[N, Da]``, one a tick.
        observed: float64 ``[N]``, time of the newest frame that each row was computed from.
    """

    start: int
    rows: FloatArray
    observed: npt.NDArray[np.float64]

    @property
    def end(self) -> int:
        """One past the last tick."""
        return self.start + len(self.rows)

    def until(self, tick: int) -> Timeline:
        """What is scheduled before a tick."""
        kept = max(min(tick - self.start, len(self.rows)), 0)
        return Timeline(self.start, self.rows[:kept], self.observed[:kept])

    def at(self, tick: int) -> FloatArray | None:
        """The action of a tick, a view; None if none is scheduled."""
        i = tick - self.start
        return self.rows[i] if 0 <= i < len(self.rows) else None


def expand(actions: FloatArray, ticks_per_step: int, interpolation: str) -> FloatArray:
    """Actions ``[Ta, Da]`` at the policy's rate as actions at the control rate, ``[Ta * ticks_per_step, Da]``.

    With ``hold`` an action is repeated; with ``linear`` it moves evenly to the next, and the last is repeated.
    """
    if ticks_per_step == 1:
        return actions
    if interpolation == "hold":
        return np.repeat(actions, ticks_per_step, axis=0)
    following = np.concatenate([actions[1:], actions[-1:]])
    share = (np.arange(ticks_per_step, dtype=np.float32) / ticks_per_step)[None, :, None]
    between = actions[:, None] * (1 - share) + following[:, None] * share
    return np.asarray(between.reshape(-1, actions.shape[1]), dtype=np.float32)


def splice(old: Timeline | None, new: Timeline, seam: int, blend: int = 0) -> Timeline | None:
    """The schedule after a chunk came.

    Args:
        old: what is scheduled so far.
        new: the whole chunk, from the tick of its observation on.
        seam: first tick that is not consumed.
        blend: ticks over which the old actions turn evenly into the new ones, where both are there; 0 to replace them.

    Returns:
        What is scheduled from ``seam`` on; None if the whole chunk is overdue.
    """
    if new.end <= seam:
        return None
    first = max(seam, new.start)
    rows, observed = new.rows[first - new.start :].copy(), new.observed[first - new.start :]
    if old is None:
        return Timeline(first, rows, observed)
    both = min(blend, old.end - first, len(rows))
    if both > 0 and first >= old.start:
        weight = (np.arange(1, both + 1, dtype=np.float32) / (blend + 1))[:, None]
        past = old.rows[first - old.start : first - old.start + both]
        rows[:both] = past + weight * (rows[:both] - past)
    if old.start <= seam < first <= old.end:  # the chunk begins later than what is next
        kept = slice(seam - old.start, first - old.start)
        rows = np.concatenate([old.rows[kept], rows])
        observed = np.concatenate([old.observed[kept], observed])
        first = seam
    return Timeline(first, rows, observed)
