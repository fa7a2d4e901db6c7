"""All that an executor knows: a state machine, events in with the time at which they happened. No clock, no threads.

``AsyncExecutor`` calls every method under its lock, so each takes microseconds.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil

from ttscompile.core.spec import Affine, FloatArray
from ttscompile.errors import DeadlineMissedError, ObservationError, StaleObservationError

from .feasibility import LatencyWindow, Tiers
from .guard import Guard, Watchdog
from .schedule import Schedule
from .settings import NO_CHUNK, Resolved
from .statistics import Recorder
from .window import Frame, ObservationWindow

SAME_TIME = 1e-6
"""Seconds; what is meant to happen at one time is not told apart by rounding."""


@dataclass(frozen=True)
class Job:
    """One call of the policy.

    Attributes:
        epoch: number of resets before it.
        frames: of the window, oldest first.
        observed: time of the newest.
        started: when it was handed to the policy.
        deadline: when the scheduled actions run out, but for those in reserve; None if there were none, and nothing can
            be missed.
        prefix: actions that are committed, ``[N, Da]`` from the observation on, one a step of the policy; None unless
            the seam is ``prefix``.
        stalled: whether the policy has stopped moving, so that it has to forget what a call goes on from.
        executed: steps of the chunk before that are given out up to the newest frame, or ``NO_CHUNK`` if none of it is
            scheduled; None for the first call of an episode.
    """

    epoch: int
    frames: list[Frame]
    observed: float
    plan: str
    started: float
    deadline: float | None
    prefix: FloatArray | None
    stalled: bool
    executed: int | None


class ExecutorState:
    """The state of one executor."""

    def __init__(
        self,
        settings: Resolved,
        normalizer: Affine | None,
        tiers: tuple[str, ...],
        latencies: Mapping[str, LatencyWindow],
    ) -> None:
        self._settings = settings
        self._guard = Guard(settings.guard, normalizer, settings.channels)
        self._tiers = Tiers(tiers, settings.down_after, settings.up_after)
        self._coverable = settings.feasibility(0.0).max_latency
        self._latencies = latencies
        self.recorder = Recorder(settings.statistics_window)
        self.epoch = 0
        self._job: Job | None = None
        self._begin_episode()

    def _begin_episode(self) -> None:
        settings, period = self._settings, 1 / self._settings.policy_hz
        self._window = ObservationWindow(settings.frames.steps, period, settings.rate_tolerance, settings.max_age)
        self._schedule = Schedule(settings, self._guard)
        self._watchdog = Watchdog(settings.stall)
        self._prepared: deque[Frame] = deque(maxlen=2 * settings.frames.steps)  # handed out
        self._used = float("-inf")  # time of the newest frame that a call was made from
        self._outcome: str | None = None  # what became of the last chunk
        self._holds = 0
        self._gap = False

    @property
    def plan(self) -> str:
        """Name of the plan that the next call runs."""
        return self._watchdog.plan or self._tiers.plan

    @property
    def ready(self) -> bool:
        """Whether a chunk of this episode has been scheduled."""
        return self._schedule.timeline is not None

    def trouble(self, now: float) -> str:
        """Why there is no chunk though frames come; empty where there is, or may be with the next call or frame."""
        if self.ready or self._window.complete is None:
            return "" if self.ready else self._window.trouble
        may = self._outcome is None and (self._job is not None or self.next_start(now) is not None)
        return "" if may else self._reason(now)[0]

    def reset(self) -> None:
        """A new episode: nothing from before is given out any more."""
        self.epoch += 1
        self.recorder.counts.resets += 1
        self.recorder.last_tick = None
        self._begin_episode()

    # Observations

    def observe(self, frame: Frame, time: float, now: float) -> None:
        """Take a frame. Raises ObservationError: it comes from the future."""
        ahead = time - now
        if not ahead <= 0.5 / self._settings.control_hz:
            what = f"the observation's time is {ahead:.6g} s ahead of the executor's clock, {now:.6f}"
            remedy = "Stamp frames with time.monotonic(), or with the clock that the executor was given."
            raise ObservationError(f"{what}. {remedy}")
        counts = self.recorder.counts
        counts.frames += 1
        added = self._window.add(time, frame, now)
        if added == "late":
            counts.frames_late += 1
            return
        counts.frames_replaced += added == "replaced"
        self._schedule.grid.tick(time)

    # Actions

    def play(self, time: float, now: float) -> FloatArray | None:
        """The scheduled action for a time; None if there is none. What is returned belongs to the caller.

        Raises:
            ExecutorError: an action for a later time was given out before, or the time is of another clock.
        """
        schedule, recorder = self._schedule, self.recorder
        tick, last = schedule.tick(time, now), schedule.last
        if last is not None and tick == last[0]:
            recorder.tick(now)
            return last[1].copy()
        if last is not None and tick > last[0] + 1:
            schedule.skip_to(tick)
        if last is None:
            schedule.begin(tick)
            self._update_due()
        timeline = schedule.timeline
        row = None if timeline is None else timeline.at(tick)
        if row is None or timeline is None:
            return None
        row = self._settings.possible(row, None if last is None else last[1])
        late = tick >= schedule.due
        if late:
            recorder.counts.reserve += 1
            self._miss()
        recorder.samples.queue_depth.add(max(schedule.due - tick - 1, 0))
        recorder.samples.action_age_ms.add(1e3 * (time - float(timeline.observed[tick - timeline.start])))
        recorder.counts.actions_clipped += int(timeline.clipped[tick - timeline.start])
        recorder.tick(now)
        self._holds, self._gap = 0, late
        self._give(tick, row, time)
        return row.copy()

    def hold(self, time: float, now: float) -> FloatArray | None:
        """The last action once more; None if there is none, or it was held long enough."""
        schedule, counts = self._schedule, self.recorder.counts
        tick, last = schedule.tick(time, now), schedule.last
        if self.ready:
            self._miss()
        held = 0 if last is None else self._holds + tick - last[0]
        if last is None or held > self._settings.max_hold:
            counts.starved += 1
            return None
        self._holds = held
        counts.holds += 1
        self.recorder.tick(now)
        action = last[1].copy()
        action[list(self._settings.displacements)] = 0  # it moved the robot already
        self._give(tick, action, time)
        return action.copy()

    def _give(self, tick: int, action: FloatArray, time: float) -> None:
        self._schedule.give(tick, action, time)
        if self._watchdog.give(action):  # then the next call takes another time
            self._update_due()

    def starved(self, time: float, now: float) -> DeadlineMissedError:
        """Why there is no action for a time, as an error to raise."""
        reason, stale = self._reason(now)
        since = "" if self._schedule.last is None else f", and the last one was held for {self._holds} ticks"
        remedy = "call reset(), or observe() and wait for the next chunk with action(timeout=...)"
        message = f"no action for time {time:.6f}{since}: {reason}. Stop the robot safely; then {remedy}."
        return (StaleObservationError if stale else DeadlineMissedError)(message)

    def _miss(self) -> None:
        """The next chunk is late; counted once, however long it takes."""
        if not self._gap:
            self._gap = True
            self.recorder.counts.deadlines_missed += 1

    def _reason(self, now: float) -> tuple[str, bool]:
        """Why nothing is scheduled, and whether observations are to blame."""
        if self._schedule.refusal is not None:
            return f"the guard refused the last chunk: {self._schedule.refusal}", False
        if self._job is not None:
            bound = self._latencies[self._job.plan].bound
            before = " for the episode before" if self._job.epoch != self.epoch else ""
            took = f"has been under way for {now - self._job.started:.4g} s"
            longest = f"the longest of the last ones took {bound:.4g} s"
            return f"a call{before} with plan {self._job.plan!r} {took}; {longest}", False
        window = self._window.complete
        if window is None:
            return f"there is no complete observation window: {self._window.why_incomplete()}", True
        age, limit = now - window.time, self._settings.max_age
        if age > limit:
            return f"the newest complete observation window is {age:.4g} s old, and may be {limit:.4g} s", True
        if window.time <= self._used:
            return f"no observation came since the last call, {now - self._used:.4g} s ago", True
        return "the next call has not started", False

    # Calls

    def next_start(self, now: float) -> float | None:
        """When the next call has to start; None: not before something new is observed.

        It starts when a frame comes: the one as many actions after that of the chunk before as the policy executes, or
        the last that is to be expected early enough, if that is sooner. If that does not come, with the one before.
        """
        window, schedule = self._window.complete, self._schedule
        if window is None or window.time <= self._used or now - window.time > self._settings.max_age:
            return None
        runs_out = schedule.runs_out(now)
        if runs_out is None or window.time + self._window.interval / 2 > schedule.executed_at:
            return now
        latest = runs_out - self._lead
        comes = window.time + self._window.interval + self._window.delay
        return max(latest, now) if comes < latest - SAME_TIME else now

    def frame_to_prepare(self, now: float) -> Frame | None:
        """A frame that has come and the next call will read, but not as its newest; None if all were handed out.

        There is none once the call is due: it computes what is left of its frames itself.
        """
        wanted = (frame for frame in self._awaited(now) if not any(frame is other for other in self._prepared))
        return next(wanted, None)

    def begin_preparing(self, frame: Frame) -> None:
        """Hand out a frame that ``frame_to_prepare`` gave."""
        self._prepared.append(frame)
        self.recorder.counts.frames_early += 1

    def awaits(self, frame: Frame, now: float) -> bool:
        """Whether a frame that was handed out is still one that the next call will read, and that is not due yet."""
        return any(frame is other for other in self._awaited(now))

    def _awaited(self, now: float) -> list[Frame]:
        """The frames that stand before the newest one of the next call, if all goes as expected: see ``next_start``."""
        window, schedule, start = self._window, self._schedule, self.next_start(now)
        if window.newest is None or (start is not None and start <= now):
            return []
        interval, runs_out = window.interval, schedule.runs_out(now)
        expected = window.newest + interval
        if runs_out is not None:
            latest = runs_out - self._lead - interval - window.delay
            if latest < schedule.executed_at - interval / 2:  # with the last frame that comes early enough
                expected = window.newest + interval * max(ceil((latest - window.newest) / interval - SAME_TIME), 1)
            elif window.newest < schedule.executed_at - interval / 2:
                expected = schedule.executed_at
        return window.before(expected)

    def begin(self, now: float) -> Job:
        """Start the call that ``next_start`` announced."""
        window = self._window.complete
        assert window is not None  # next_start said so
        schedule, prefix = self._schedule, None
        executed = None if self._outcome is None else NO_CHUNK
        if self._outcome == "scheduled":
            executed = schedule.steps(self._used, window.time)
        self._used = window.time
        self.recorder.samples.observation_age_ms.add(1e3 * (now - window.time))
        if self._settings.seam == "prefix":
            prefix = schedule.committed(window.time, now + self._latency)
        stalled, runs_out = self._watchdog.plan is not None, schedule.runs_out(now)
        self._job = Job(self.epoch, window.frames, window.time, self.plan, now, runs_out, prefix, stalled, executed)
        return self._job

    def finish(self, job: Job, actions: FloatArray, now: float, far: bool = False) -> str:
        """Take the chunk of a call.

        Args:
            actions: ``[horizon + reserve, Da]``, the playable part of the prediction.

        Returns:
            What became of it: ``scheduled``, ``discarded``, ``refused`` or ``overdue``.
        """
        counts, self._job = self.recorder.counts, None
        counts.calls += 1
        counts.calls_outside += far
        counts.stalls += job.stalled
        latency = now - job.started
        self._latencies[job.plan].add(latency)
        self.recorder.samples.latency_ms.add(1e3 * latency)
        if job.epoch != self.epoch:
            counts.chunks_discarded += 1
            return "discarded"
        if job.stalled:
            self._watchdog.restart()
            self._update_due()
        self._outcome = outcome = self._schedule.add(job.observed, actions, now, alone=job.stalled)
        if outcome == "scheduled":
            counts.chunks += 1
            self._update_due()
        elif outcome == "refused":
            counts.chunks_refused += 1
            self.recorder.last_refusal = self._schedule.refusal
        else:
            counts.chunks_overdue += 1
        if job.deadline is not None:
            self.recorder.samples.slack_ms.add(1e3 * (job.deadline - now))
        late = job.deadline is not None and now > job.deadline
        if outcome == "refused" and not late:  # a faster plan is no remedy for that, nor has it kept up
            return outcome
        if job.stalled:  # it says nothing about the tier
            return outcome
        switched = self._tiers.after_call(missed=late or self._schedule.runs_out(now) is None)
        counts.switches_down += switched == 1
        counts.switches_up += switched == -1
        if switched:
            self._update_due()
        return outcome

    def fail(self) -> None:
        """The call under way came to nothing."""
        self._job = None

    @property
    def _latency(self) -> float:
        return self._latencies[self.plan].reckoned(self._coverable)

    @property
    def _lead(self) -> float:
        """Seconds that the next call has to start before its chunk is needed."""
        return self._latency + self._settings.margin_ticks / self._settings.control_hz

    def _update_due(self) -> None:
        """Say what of the schedule is in reserve: what goes on for longer than the next call has to take.

        At least half a tick is left between the two, so that a frame which comes so late still starts its call.
        """
        if self.ready:
            self._schedule.need_by(self._schedule.executed_at + self._window.delay + self._lead)
