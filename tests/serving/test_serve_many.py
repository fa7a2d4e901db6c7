"""Many small messages and connections: the server is afterwards what it was before."""

from __future__ import annotations

import gc
import threading
import time
import tracemalloc
from pathlib import Path

import pytest

from .served import SETTINGS, served, talk
from .serving import connected, serving

MOST_BYTES_EACH = 20
LET_GO_SECONDS = 10.0
"""The server closes its side of a connection a while after the client's; one that leaks never does."""


def opened() -> tuple[int, int]:
    """Open files, threads."""
    return len([*Path("/proc/self/fd").iterdir()]), threading.active_count()


def most(files: int, threads: int) -> bool:
    """Whether no more than these are open, at the latest when the server has had its time."""
    until = time.monotonic() + LET_GO_SECONDS
    while (now := opened())[0] > files or now[1] > threads:
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def python_bytes() -> int:
    """Bytes of Python's objects."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def talk_often(url: str, connections: int, rounds: int) -> int:
    """Number of messages."""
    count = 0
    for _ in range(connections):
        with connected(url) as call:
            count += len(talk(call, rounds))
    return count


@pytest.mark.slow
def test_memory_files_and_threads_stay_as_they_were() -> None:
    assert Path("/proc/self/fd").is_dir(), "this test needs Linux"
    with serving(settings=SETTINGS) as url:
        tracemalloc.start()
        try:
            talk_often(url, 20, 10)
            files, threads = opened()
            grown = []
            for _ in range(3):  # what leaks does so every time; what is imported or kept once does not
                bytes_before = python_bytes()
                count = talk_often(url, 30, 25)
                assert most(files, threads), f"{opened()} files and threads are open, and {files, threads} were before"
                grown.append((python_bytes() - bytes_before) / count)
                if grown[-1] < MOST_BYTES_EACH:
                    break
        finally:
            tracemalloc.stop()
    assert min(grown) < MOST_BYTES_EACH


@pytest.mark.soak
def test_what_is_printed_of_a_million() -> None:
    """A short version of ``served.py``."""
    first, *_, last = made = served(80)
    assert [tenth["messages"] for tenth in made] == [8 * number for number in range(1, 11)]
    assert (last["descriptors"], last["threads"]) == (first["descriptors"], first["threads"])
    assert 0 < last["median_ms"] < 1000
