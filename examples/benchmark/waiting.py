"""For how much of their time the threads of this process wait for a processor that other programs have.

A time by the clock counts as that of a quiet machine where this share is small. Linux says it, of threads that live.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

TASKS = Path("/proc/self/task")


def from_now_on() -> Callable[[], str]:
    """A function that says it of the time from now to its call."""
    before = dict(_by_thread())

    def told() -> str:
        ran = waited = 0
        for thread, (runs, waits) in _by_thread():
            ran += runs - before.get(thread, (0, 0))[0]
            waited += waits - before.get(thread, (0, 0))[1]
        share = f"{waited / (ran + waited):.0%}" if ran + waited else "an unknown part"
        return f"threads waited {share} of their time for a processor"

    return told


def _by_thread() -> Iterator[tuple[str, tuple[int, int]]]:
    """Of each thread the nanoseconds that it ran, and that it could have run."""
    for task in TASKS.glob("*/schedstat"):
        with suppress(OSError):  # it ended just now
            ran, waited, _ = map(int, task.read_text().split())
            yield task.parent.name, (ran, waited)
