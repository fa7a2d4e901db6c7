"""Many small messages and connections: the server is afterwards what it was before."""

from __future__ import annotations

import gc
import threading
import tracemalloc
from contextlib import suppress
from pathlib import Path

from ttscompile.runtimes.executor import ExecutorSettings

from .serving import ServerError, connected, serving

SETTINGS = ExecutorSettings(max_hold=1000, trace_events=0, statistics_window=16)
"""What is remembered on purpose is soon full."""

MOST_BYTES_EACH = 20


def state() -> tuple[int, int, int]:
    """Bytes of Python's objects, open files, threads."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0], len([*Path("/proc/self/fd").iterdir()]), threading.active_count()


def talk(url: str, connections: int, rounds: int) -> int:
    """Number of messages: two that are right and two that are not, a round."""
    for _ in range(connections):
        with connected(url) as call:
            for _ in range(rounds):
                call("observe", obs={"obs": [0.0, 0.0]})
                call("info")
                for method in ("observe", "nothing"):
                    with suppress(ServerError):
                        call(method)
    return 4 * connections * rounds


def test_memory_files_and_threads_stay_as_they_were() -> None:
    assert Path("/proc/self/fd").is_dir(), "this test needs Linux"
    with serving(settings=SETTINGS) as url:
        tracemalloc.start()
        try:
            talk(url, 20, 10)
            bytes_before, *before = state()
            count = talk(url, 30, 25)
            bytes_after, *after = state()
        finally:
            tracemalloc.stop()
    assert after == before
    assert bytes_after - bytes_before < MOST_BYTES_EACH * count
