"""What a robot did and will do in one episode: actions given out, scheduled, and in reserve. No clock, no threads.

Time is cut into control ticks. A tick is *consumed* when its action has been given out; a new chunk starts to count at
the first tick that is not, however long its inference took::

    tick        10   11   12   13   14   15   16   17
    scheduled    a    a    a    a    a                      chunk a, observed at tick 8
    consumed     x    x    x                                given out while b was computed
    chunk b      .    .    .    b    b    b    b    b       observed at tick 10: its first three actions are overdue
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import floor

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import FloatArray
from ttscompile.errors import ExecutorError

from .guard import Guard
from .settings import ExecutorSettings, Resolved

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


FAR = 1e6
"""Seconds from now that a time may be at most; what is further is of another clock."""


class Schedule:
    """The actions of one episode by control tick.

    Attributes:
        grid: from seconds to ticks.
        timeline: what is scheduled; None before the first chunk.
        due: first tick that the next chunk is needed for; what is scheduled after that is in reserve.
        refusal: why the last chunk was refused; None if it was not.
    """

    def __init__(self, settings: ExecutorSettings, resolved: Resolved, guard: Guard) -> None:
        self._settings, self._resolved, self._guard = settings, resolved, guard
        self.grid = TickGrid(resolved.control_hz)
        self.timeline: Timeline | None = None
        self.due = 0
        self.refusal: str | None = None
        most = (resolved.horizon + resolved.reserve) * resolved.ticks_per_step
        self._played: deque[tuple[int, FloatArray]] = deque(maxlen=max(most, 3))

    @property
    def last(self) -> tuple[int, FloatArray] | None:
        """Tick and action that were given out last; None before the first."""
        return self._played[-1] if self._played else None

    def tick(self, time: float, now: float) -> int:
        """The tick of a time for which an action is asked.

        Raises:
            ExecutorError: an action for a later time was given out before, or the time is of another clock.
        """
        if not abs(time - now) < FAR:
            remedy = "Give times of time.monotonic(), or of the clock that the executor was given."
            raise ExecutorError(f"an action was asked for {time - now:.6g} s from now. {remedy}")
        tick = self.grid.tick(time)
        if self.last is not None and tick < self.last[0]:
            what = f"an action was asked for {self.last[0] - tick} ticks before the last one that was given out"
            remedy = "Times must not go backwards within an episode; one control loop asks for actions."
            raise ExecutorError(f"{what}. {remedy}")
        return tick

    def give(self, tick: int, action: FloatArray, time: float) -> None:
        """Take note that an action was given out for a time."""
        self.grid.follow(time, tick)
        self._played.append((tick, action))

    def add(self, observed: float, actions: FloatArray, now: float) -> str:
        """Let a chunk join what is scheduled, if the guard has nothing against it.

        Args:
            actions: ``[horizon + reserve, Da]``; the reserve is left out where the guard refuses that alone.
        """
        settings, resolved = self._settings, self._resolved
        self.refusal = self._guard.refuse(actions[: resolved.horizon])
        if self.refusal is not None:
            return "refused"
        if self._guard.refuse(actions[resolved.horizon :]) is not None:
            actions = actions[: resolved.horizon]
        rows = expand(actions, resolved.ticks_per_step, settings.interpolation)
        start = self.grid.tick(observed)
        new = Timeline(start, rows, np.full(len(rows), observed))
        seam = start if self.last is None else self.last[0] + 1
        spliced = splice(self.timeline, new, seam, settings.blend_steps if settings.seam == "blend" else 0)
        if spliced is None or new.end <= self.grid.tick(now):
            return "overdue"
        played = [action for _, action in list(self._played)[-3:]]
        past = np.stack(played) if played else np.empty((0, resolved.channels), np.float32)
        refusal = self._guard.refuse_motion(past, spliced.rows)
        if refusal is not None:  # without its reserve it may do, if anything is left then
            spliced = spliced.until(start + resolved.horizon * resolved.ticks_per_step)
            self.refusal = self._guard.refuse_motion(past, spliced.rows) if len(spliced.rows) else refusal
            if self.refusal is not None:
                return "refused"
        self.timeline = spliced
        return "scheduled"

    @property
    def executed(self) -> float:
        """When the policy would have executed the newest chunk, of which there must be one, and so observes again."""
        assert self.timeline is not None
        return float(self.timeline.observed[-1]) + self._resolved.horizon / self._resolved.policy_hz

    def need_by(self, time: float) -> None:
        """Say when the next chunk is needed: at the end of what is scheduled, or after a time, if that is sooner."""
        if self.timeline is not None:
            self.due = min(self.grid.tick(time) + 1, self.timeline.end)

    def runs_out(self, now: float) -> float | None:
        """When the first tick comes for which nothing is scheduled but the reserve; None if that is so already."""
        if self.timeline is None:
            return None
        end = self.grid.time(self.due)
        return end if end > now else None

    def committed(self, observed: float, until: float) -> FloatArray:
        """Actions given out and scheduled between two times, one a step of the policy, ``[N, Da]``."""
        tick, last = self.grid.tick(observed), self.grid.tick(until)
        played = dict(self._played)
        rows: list[FloatArray] = []
        while tick <= last and len(rows) < self._resolved.horizon:
            row = played.get(tick)
            if row is None and self.timeline is not None:
                row = self.timeline.at(tick)
            if row is None:
                break
            rows.append(row)
            tick += self._resolved.ticks_per_step
        return np.stack(rows) if rows else np.empty((0, self._resolved.channels), np.float32)
