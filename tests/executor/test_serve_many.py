"""Many small messages and connections: the server is afterwards what it was before."""

from __future__ import annotations

import gc
import threading
import tracemalloc
from pathlib import Path

from .served import SETTINGS, served, talk
from .serving import connected, serving

MOST_BYTES_EACH = 20


def state() -> tuple[int, int, int]:
    """Bytes of Python's objects, open files, threads."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0], len([*Path("/proc/self/fd").iterdir()]), threading.active_count()


def talk_often(url: str, connections: int, rounds: int) -> int:
    """Number of messages."""
    count = 0
    for _ in range(connections):
        with connected(url) as call:
            count += len(talk(call, rounds))
    return count


def test_memory_files_and_threads_stay_as_they_were() -> None:
    assert Path("/proc/self/fd").is_dir(), "this test needs Linux"
    with serving(settings=SETTINGS) as url:
        tracemalloc.start()
        try:
            talk_often(url, 20, 10)
            bytes_before, *before = state()
            count = talk_often(url, 30, 25)
            bytes_after, *after = state()
        finally:
            tracemalloc.stop()
    assert after == before
    assert bytes_after - bytes_before < MOST_BYTES_EACH * count


def test_what_is_printed_of_a_million() -> None:
    """A short version of ``served.py``."""
    first, *_, last = made = served(400)
    assert [tenth["messages"] for tenth in made] == [40 * number for number in range(1, 11)]
    assert (last["descriptors"], last["threads"]) == (first["descriptors"], first["threads"])
    assert 0 < last["median_ms"] < 1000
