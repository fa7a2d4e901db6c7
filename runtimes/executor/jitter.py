"""How punctual a control loop is beside an executor: the same loop, alone and with the policy at work."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Jitter:
    """How late the ticks of a loop were, in milliseconds, and what the loop's own work took.

    Attributes:
        hz: rate of the loop.
        ticks: how many ticks were measured.
        p50: median lateness.
        p99: 99th percentile of the lateness.
        max: the latest tick.
        late: ticks that were later than half a period.
        work_us: median of the work of a tick, microseconds.
    """

    hz: float
    ticks: int
    p50: float
    p99: float
    max: float
    late: int
    work_us: float

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)


def measure_jitter(hz: float, seconds: float, work: Callable[[], object] = lambda: None) -> Jitter:
    """Run a loop in real time, sleeping between ticks, and measure how late it wakes.

    Args:
        hz: rate of the loop.
        seconds: how long it runs.
        work: called in every tick.
    """
    ticks = max(int(seconds * hz), 1)
    late, took = np.empty(ticks), np.empty(ticks)
    start = time.perf_counter()
    for i in range(ticks):
        due = start + (i + 1) / hz
        time.sleep(max(due - time.perf_counter(), 0.0))
        woke = time.perf_counter()
        work()
        late[i], took[i] = woke - due, time.perf_counter() - woke
    p50, p99 = (float(p) for p in np.percentile(1e3 * late, [50, 99]))
    return Jitter(
        hz=hz,
        ticks=ticks,
        p50=p50,
        p99=p99,
        max=float(1e3 * late.max()),
        late=int(np.count_nonzero(late > 0.5 / hz)),
        work_us=float(1e6 * np.median(took)),
    )
