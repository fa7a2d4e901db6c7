"""What the executor counts and measures, in memory of a fixed size; and what happened when, as a trace.

The trace is in Chrome's trace event format, which https://ui.perfetto.dev opens: "Trace Event Format", Google, 2016.
Complete events (``X``) and instants (``i``); times in microseconds.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.files import replace_file

if TYPE_CHECKING:
    from ttscompile.runtimes.frames import FrameWork
    from ttscompile.runtimes.report import Timings


class Samples:
    """The last measurements of one quantity, and the extremes of all of them."""

    def __init__(self, size: int) -> None:
        self._ring = np.empty(size, np.float64)
        self.count = 0
        self._low, self._high = float("inf"), float("-inf")

    def add(self, value: float) -> None:
        """Take a measurement."""
        self._ring[self.count % len(self._ring)] = value
        self.count += 1
        if value > self._high:
            self._high = value
        if value < self._low:
            self._low = value

    def copy(self) -> tuple[npt.NDArray[np.float64], int, float, float]:
        """The kept measurements, how many there were, the least and the largest: all that ``summary`` needs."""
        return self._ring[: self.count].copy(), self.count, self._low, self._high


@dataclass(frozen=True)
class Summary:
    """Percentiles of the last measurements; number, least and largest of all of them.

    Attributes:
        count: measurements since the executor was made.
        min: the least of all of them.
        p50: of the last ones, see ``ExecutorSettings.statistics_window``; so are the other percentiles.
        max: the largest of all of them.
    """

    count: int
    min: float
    p50: float
    p95: float
    p99: float
    max: float


def summary(kept: npt.NDArray[np.float64], count: int, low: float, high: float) -> Summary | None:
    """Summary of what ``Samples.copy`` gave; None if nothing was measured."""
    if count == 0:
        return None
    p50, p95, p99 = (float(p) for p in np.percentile(kept, [50, 95, 99]))
    return Summary(count, low, p50, p95, p99, high)


@dataclass(frozen=True, kw_only=True)
class ExecutorStatistics:
    """What an executor did so far.

    Attributes:
        plan: name of the plan that the next call runs.
        identity: of the artifact; empty for a policy that is none.
        ticks: actions that were given out, those in reserve and held ones included.
        reserve: of these, actions beyond what was planned with, because the next chunk was late.
        holds: of these, the last action given out again because there was no other.
        actions_clipped: of these, scheduled actions that the guard had changed, or that were made from such; see
            ``GuardLimits.clip``.
        starved: times that there was no action and none could be held, so that ``action`` raised. Before the first
            chunk of an episode this is no missed deadline.
        frames: observations taken.
        frames_late: of these, too old to be part of a window.
        frames_replaced: of these, of the same time as one that was there.
        frames_early: of these, handed to ``prepare_frame`` before the call that was expected to read them.
        calls: of the policy, finished; those that measured its latency at the start are not counted.
        calls_outside: of these, so far outside of what was recorded that they had no correction.
        stalls: of these, made with ``stall_plan`` because the actions had stopped moving.
        chunks: of the calls, scheduled.
        chunks_refused: of these, refused by the guard.
        chunks_overdue: wholly in the past when they came.
        chunks_discarded: computed from observations before a reset.
        deadlines_missed: times that the scheduled actions, without those in reserve, had run out before the next chunk
            came.
        switches_down: to a faster plan.
        switches_up: back to a slower one.
        resets: how often the executor was reset.
        last_refusal: why the guard refused the last chunk that it refused; None if it refused none.
        latency_ms: time that calls took.
        observation_age_ms: of the newest frame when a call starts.
        action_age_ms: of the newest frame that an action was computed from, when it is given out.
        slack_ms: from the end of a call to when its chunk is needed; negative: it came late.
        queue_depth: scheduled ticks after the one that is given out, without those in reserve.
        tick_ms: from one ``action`` to the next: the control rate as it is, not as it was declared.
    """

    plan: str
    identity: str
    ticks: int
    reserve: int
    holds: int
    actions_clipped: int
    starved: int
    frames: int
    frames_late: int
    frames_replaced: int
    frames_early: int
    calls: int
    calls_outside: int
    stalls: int
    chunks: int
    chunks_refused: int
    chunks_overdue: int
    chunks_discarded: int
    deadlines_missed: int
    switches_down: int
    switches_up: int
    resets: int
    last_refusal: str | None
    latency_ms: Summary | None
    observation_age_ms: Summary | None
    action_age_ms: Summary | None
    slack_ms: Summary | None
    queue_depth: Summary | None
    tick_ms: Summary | None

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)


COUNTS, MEASURED = (
    tuple(each.name for each in fields(ExecutorStatistics) if each.type == kind) for kind in ("int", "Summary | None")
)
"""Of these fields what is counted, and what is measured."""


class Recorder:
    """Counts and samples of an executor, by the names that ``ExecutorStatistics`` has for them.

    Changed under the executor's lock only; nothing here allocates while the loop runs.
    """

    def __init__(self, window: int) -> None:
        self.counts = SimpleNamespace(**dict.fromkeys(COUNTS, 0))
        self.samples = SimpleNamespace(**{name: Samples(window) for name in MEASURED})
        self.last_refusal: str | None = None
        self.last_tick: float | None = None  # None where the loop stands still on purpose

    def tick(self, now: float) -> None:
        """An action was given out."""
        self.counts.ticks += 1
        if self.last_tick is not None:
            self.samples.tick_ms.add(1e3 * (now - self.last_tick))
        self.last_tick = now

    def copy(self) -> dict[str, Any]:
        """What ``statistics`` needs, copied while the lock is held; the percentiles are made without it."""
        samples = {name: each.copy() for name, each in vars(self.samples).items()}
        return {**vars(self.counts), **samples, "last_refusal": self.last_refusal}


def statistics(plan: str, copied: dict[str, Any], identity: str = "") -> ExecutorStatistics:
    """Statistics from what ``Recorder.copy`` gave."""
    summaries = {name: summary(*copied[name]) for name in MEASURED}
    return ExecutorStatistics(plan=plan, identity=identity, **{**copied, **summaries})


def tokens_of(work: FrameWork | None) -> dict[str, Any]:
    """Of each new frame whose tokens are reused how many were computed, and why, as arguments of an event."""
    return {"tokens": [asdict(one) for one in work.by_camera]} if work and work.by_camera else {}


Event: TypeAlias = tuple[str, str, int, float, float, Mapping[str, Any] | None]
"""Phase, name, thread, start and duration in seconds, arguments."""

CONTROL, WORKER, PRUNER = 1, 2, 3
"""Threads as the trace numbers them; a runtime may let the pruner run beside the decoding."""


class Trace:
    """The last events. Adding one takes no lock: a deque's ``append`` is atomic."""

    def __init__(self, events: int, identity: str = "") -> None:
        self.on = events > 0
        self._identity = identity
        self._events: deque[Event] = deque(maxlen=events)

    def span(
        self, thread: int, name: str, start: float, duration: float, args: Mapping[str, Any] | None = None
    ) -> None:
        """Something that took time."""
        self._events.append(("X", name, thread, start, duration, args))

    def instant(self, thread: int, name: str, at: float, args: Mapping[str, Any] | None = None) -> None:
        """Something that happened."""
        self._events.append(("i", name, thread, at, 0.0, args))

    def frame(self, start: float, end: float, work: FrameWork) -> None:
        """What depends on a frame alone was computed before the call that reads it."""
        known = {"computed": work.computed, "known": work.remembered}
        self.span(WORKER, "frame", start, end - start, known | tokens_of(work))

    def call(self, start: float, end: float, args: Mapping[str, Any], timings: Timings | None) -> None:
        """A call of the policy, with its parts if there is a report of them."""
        self.span(WORKER, "inference", start, end - start, args)
        if timings is None:
            return
        at = max(end - timings.total / 1e3, start)
        self.span(WORKER, "prologue", at, timings.prologue / 1e3)
        if timings.frames > 0:
            self.span(WORKER, "frames", at, timings.frames / 1e3)
        at += timings.prologue / 1e3
        if timings.pruner > 0:
            self.span(PRUNER, "pruner", at, timings.pruner / 1e3)
        overlapped = timings.wait_pruner < timings.pruner  # step 0 is decoded beside it
        before, within = (0.0, timings.wait_pruner) if overlapped else (timings.wait_pruner, 0.0)
        self.span(WORKER, "decode", at + before / 1e3, (timings.decode + within) / 1e3)

    def to_json(self, process: str = "ttscompile") -> dict[str, Any]:
        """The document."""
        events = sorted(self._events.copy(), key=lambda event: event[3])
        zero = events[0][3] if events else 0.0
        names = [
            ("process_name", 0, process),
            ("thread_name", CONTROL, "control loop"),
            ("thread_name", WORKER, "policy"),
            ("thread_name", PRUNER, "pruner"),
        ]
        return {
            "displayTimeUnit": "ms",
            "otherData": {"identity": self._identity},
            "traceEvents": [
                *({"ph": "M", "name": what, "pid": 1, "tid": tid, "args": {"name": name}} for what, tid, name in names),
                *(_as_json(event, zero) for event in events),
            ],
        }

    def write(self, path: str | Path, process: str = "ttscompile") -> None:
        """Write the document to a file, whole or not at all. Raises OSError: it cannot be written."""
        replace_file(Path(path), json.dumps(self.to_json(process), allow_nan=False).encode())


def _as_json(event: Event, zero: float) -> dict[str, Any]:
    phase, name, thread, start, duration, args = event
    made = {"ph": phase, "name": name, "pid": 1, "tid": thread, "ts": round(1e6 * (start - zero), 3)}
    lasting: dict[str, Any] = {"dur": round(1e6 * duration, 3)} if phase == "X" else {"s": "t"}
    return made | lasting | ({"args": dict(args)} if args else {})
