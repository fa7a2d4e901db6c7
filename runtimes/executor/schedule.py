"""What a robot did and will do in one episode: actions given out, scheduled, and in reserve. No clock, no threads."""

from collections import deque
from dataclasses import replace

import numpy as np

from ttscompile.core.spec import FloatArray
from ttscompile.errors import ExecutorError

from .guard import Guard
from .settings import Resolved
from .timeline import TickGrid, Timeline, expand, splice

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

    def __init__(self, settings: Resolved, guard: Guard) -> None:
        self._settings, self._guard = settings, guard
        self.grid = TickGrid(settings.control_hz)
        self.timeline: Timeline | None = None
        self.due = 0
        self.refusal: str | None = None
        self._first = 0  # no chunk begins before this tick: that of the first action, where the robot stood until then
        self._ahead = 0.0  # seconds before its time at which the last action was asked for
        most = (settings.horizon + settings.reserve) * settings.ticks_per_step
        self._played: deque[tuple[int, FloatArray]] = deque(maxlen=max(most, 3))

    @property
    def last(self) -> tuple[int, FloatArray] | None:
        """Tick and action that were given out last; None before the first."""
        return self._played[-1] if self._played else None

    def tick(self, time: float, now: float) -> int:
        """The tick of a time for which an action is asked now; takes note of how far ahead of it that is.

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
        self._ahead = max(time - now, 0.0)
        return tick

    def give(self, tick: int, action: FloatArray, time: float) -> None:
        """Take note that an action was given out for a time."""
        self.grid.follow(time, tick)
        self._played.append((tick, action))

    def add(self, observed: float, actions: FloatArray, now: float, alone: bool = False) -> str:
        """Let a chunk join what is scheduled, if the guard has nothing against it.

        Args:
            actions: ``[horizon + reserve, Da]``; the reserve is left out where the guard refuses that alone.
            alone: whether no mean of it and others is made.

        Returns:
            What became of it: ``scheduled``, ``refused`` (``refusal`` says why) or ``overdue``.
        """
        settings = self._settings
        self.refusal = self._guard.refuse(actions[: settings.horizon])
        if self.refusal is not None:
            return "refused"
        if self._guard.refuse(actions[settings.horizon :]) is not None:
            actions = actions[: settings.horizon]
        rows = expand(actions, settings.ticks_per_step, settings.interpolation)
        start, reached = max(self.grid.tick(observed), self._first), self.grid.tick(now + self._ahead)
        new = Timeline.of(start, rows, observed)
        if self._guard.clips:
            new = new.clipped_to(self._guard.bounded(rows))
        seam = start if self.last is None else self.last[0] + 1
        blend = settings.blend_steps if settings.seam == "blend" else 0
        ensemble = settings.ensemble_coefficient if settings.seam == "ensemble" and not alone else None
        if settings.displacements and self.last is not None:
            late = max(seam, reached) - start
            new = replace(new, rows=self._caught_up(new, rows, late, max(blend, 1)))
        # Before the first action nothing of an older chunk was played and the robot stood: the newest takes its place.
        old = None if self.last is None else self.timeline
        spliced = splice(old, new, seam, blend, ensemble, settings.displacements)
        if spliced is None or new.end <= reached:
            return "overdue"
        past = self._past
        if self._guard.clips:
            spliced = spliced.clipped_to(self._guard.limited(past, spliced.rows))
        refusal = self._guard.refuse_motion(past, spliced.rows)
        if refusal is not None:  # without its reserve it may do, if anything is left then
            spliced = spliced.between(seam, start + settings.horizon * settings.ticks_per_step)
            self.refusal = self._guard.refuse_motion(past, spliced.rows) if len(spliced.rows) else refusal
            if self.refusal is not None:
                return "refused"
        self.timeline = spliced
        return "scheduled"

    def _caught_up(self, new: Timeline, meant: FloatArray, late: int, steps: int) -> FloatArray:
        """The rows of a chunk; what the robot should have been displaced by when it came is made up for after that.

        A position is right whenever it is reached. But displacements that are overdue would be lost, those that were
        given out in their place would stay, and what went wrong is what a policy corrects with its first ones.

        Args:
            meant: its rows as they were before the guard clipped them.
            late: rows that are overdue.
            steps: rows to make up for it in, or more if the guard's bounds leave no room.
        """
        rows, channels = new.rows.copy(), list(self._settings.displacements)
        made = [action[channels] for tick, action in self._played if new.start <= tick < new.start + late]
        left = meant[:late, channels].sum(axis=0) - np.sum(made, axis=0, dtype=np.float32)
        for i, (row, wanted) in enumerate(zip(rows[late:], meant[late:, channels], strict=True)):
            row[channels] = wanted + left / max(steps - i, 1)
            row[channels] = self._guard.bounded(row)[channels]
            left += wanted - row[channels]
        return rows

    def begin(self, tick: int) -> None:
        """Have the chunk begin at the tick of the episode's first action: until then the robot is where it was seen.

        None of its actions is overdue, nor of the next chunk's if it was observed before that tick. Displacements that
        are left out would be lost for good, and the robot would jump to a place that it should have reached by then. A
        chunk that would be over is not played.
        """
        timeline = self.timeline
        if self.last is None and timeline is not None and timeline.start < tick < timeline.end:
            self._first, self.timeline = tick, replace(timeline, start=tick)

    def skip_to(self, tick: int) -> None:
        """Have what follows keep the limits of a guard that clips, where nothing is given out for the ticks before."""
        if self._guard.clips and self.timeline is not None and self.timeline.at(tick) is not None:
            rest = self.timeline.between(tick, self.timeline.end)
            self.timeline = rest.clipped_to(self._guard.limited(self._past, rest.rows))

    @property
    def _past(self) -> FloatArray:
        """The last three actions that were given out, or as many as there are, oldest first."""
        played = [action for _, action in list(self._played)[-3:]]
        return np.stack(played) if played else np.empty((0, self._settings.channels), np.float32)

    @property
    def executed_at(self) -> float:
        """When the policy would have executed the newest chunk, of which there must be one, and so observes again."""
        assert self.timeline is not None
        begun = max(float(self.timeline.observed.max()), self.grid.time(self._first))
        return begun + self._settings.horizon / self._settings.policy_hz

    def steps(self, since: float, until: float) -> int:
        """Steps of the policy that are given out from one frame to another; none while the robot stands still."""
        if self.last is None:
            return 0
        first = self.grid.time(self._first)
        return round((max(until, first) - max(since, first)) * self._settings.policy_hz)

    def need_by(self, time: float) -> None:
        """Say when the next chunk is needed: at the end of what is scheduled, or after a time, if that is sooner."""
        if self.timeline is not None:
            self.due = min(self.grid.tick(time + self._ahead) + 1, self.timeline.end)

    def runs_out(self, now: float) -> float | None:
        """When the first tick is asked for that has nothing scheduled but the reserve; None if that is so already."""
        if self.timeline is None:
            return None
        end = self.grid.time(self.due) - self._ahead
        return end if end > now else None

    def committed(self, observed: float, until: float) -> FloatArray:
        """Actions given out by a time, or scheduled till then, one a step of the policy, no more than it takes."""
        most = min(self._settings.horizon, self._settings.trained_prefix or self._settings.horizon)
        tick, last = self.grid.tick(observed), self.grid.tick(until + self._ahead)
        played, timeline, rows = dict(self._played), self.timeline, list[FloatArray]()
        if timeline is not None and not played:  # it begins with the first action, and so does the next chunk
            timeline = replace(timeline, start=tick)
        while tick <= last and len(rows) < most:
            row = played.get(tick)
            if row is None and timeline is not None:
                row = timeline.at(tick)
            if row is None:
                break
            rows.append(row)
            tick += self._settings.ticks_per_step
        return np.stack(rows) if rows else np.empty((0, self._settings.channels), np.float32)
