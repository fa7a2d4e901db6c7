"""What happened when, in Chrome's trace event format; https://ui.perfetto.dev opens the file.

Format: "Trace Event Format", Google, 2016. Complete events (``X``) and instants (``i``); times in microseconds.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ttscompile.artifact.files import replace_file

if TYPE_CHECKING:
    from ttscompile.runtimes.frames import FrameWork
    from ttscompile.runtimes.report import Timings

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
        self.span(WORKER, "frame", start, end - start, {"computed": work.computed, "known": work.remembered})

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
