"""What the executor costs the control loop. Figures: ``pytest FILE --benchmark-only``."""

import time

import numpy as np
import pytest

from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings

from .simulation import FakeClock, Quick

pytestmark = pytest.mark.alone

MOST = 20e-6
"""Seconds that ``action`` may take, median."""
HZ, ROUNDS = 500, 3000


@pytest.fixture
def running():  # type: ignore[no-untyped-def]
    settings = ExecutorSettings(policy_hz=0.5, max_hold=10**9)  # a chunk has actions for a minute
    executor = AsyncExecutor(Quick(FakeClock()), HZ, settings, latencies={"dense": 0.0})
    with executor:
        now = time.monotonic()
        for at in (now - 2, now):
            executor.observe({"obs": np.zeros(2)}, at)
        executor.action(timeout=5.0)
        yield executor


def test_action_takes_less_than_twenty_microseconds(running: AsyncExecutor, benchmark) -> None:  # type: ignore[no-untyped-def]
    """Each call asks for the next tick, ahead of time, so that each gives out an action that is new."""
    start = time.monotonic()
    took = []

    def ask(at: float) -> None:
        before = time.perf_counter()
        running.action(at)
        took.append(time.perf_counter() - before)

    ticks = iter(range(1, ROUNDS + 1))
    benchmark.pedantic(ask, setup=lambda: ((start + next(ticks) / HZ,), {}), rounds=ROUNDS)
    counted = running.statistics()
    assert len(took) == ROUNDS if benchmark.enabled else len(took) == 1
    assert np.median(took) < MOST
    assert (counted.starved, counted.holds) == (0, 0)
    depth = counted.queue_depth  # of actions that were scheduled, not given out a second time
    assert depth is not None and depth.count >= len(took)


def test_observe_is_no_slower_than_a_tick_allows(running: AsyncExecutor, benchmark) -> None:  # type: ignore[no-untyped-def]
    frame = {"obs": np.zeros(2)}
    benchmark.pedantic(running.observe, (frame,), rounds=500)
    took = []
    for _ in range(500):
        start = time.perf_counter()
        running.observe(frame)
        took.append(time.perf_counter() - start)
    assert np.median(took) < 10 * MOST
