"""The trace says of each call whether what pictures and words decide together was computed or known."""

from __future__ import annotations

from pathlib import Path

import pytest

import ttscompile
from tests.families import scenes
from tests.families.cameras import CAMERAS
from tests.once import Once
from ttscompile import AsyncExecutor, ExecutorSettings
from ttscompile.core.coercion import Array

from .simulation import REAL_LIMIT, FakeClock

pytestmark = pytest.mark.slow

HZ, TICKS = 10.0, 16


def seen(word: int, tick: int) -> dict[str, Array]:
    """A frame: the state is another at each tick, and pictures stand."""
    own = scenes.observation(word=word, state=tick)
    return {key: value[0, 0] if key in CAMERAS else value[0] for key, value in own.items()}


def traced(folder: Path) -> list[tuple[int, int]]:
    """Of each call the scenes that were computed, and that were known; from half of the ticks on with another word."""
    clock, settings = FakeClock(), ExecutorSettings(trace_events=1000)
    policy = ttscompile.load(folder, seed=0)
    executor = AsyncExecutor(policy, HZ, settings, clock=clock, latencies={"dense": 0.04}, open_timeout=REAL_LIMIT)
    clock.settle()
    try:
        for tick in range(TICKS):
            executor.observe(seen(2 + (tick >= TICKS // 2), tick))
            clock.settle()
            if executor.ready:
                executor.action()
            clock.advance(1 / HZ)
        calls = [event for event in executor.trace.to_json()["traceEvents"] if event["name"] == "inference"]
        return [(event["args"]["scenes"], event["args"]["scenes known"]) for event in calls]
    finally:
        clock.free()
        executor.close(timeout=REAL_LIMIT)


def test_a_scene_that_stands_is_told_as_known(once: Once) -> None:
    found = traced(once.folder("scenes", scenes.compile_all) / "one")
    assert len(found) > 4 and found[0] == (1, 0)
    assert found.count((1, 0)) == 2 and found.count((0, 1)) == len(found) - 2, "the word is another one once"
