"""Frames at many kilohertz from several threads, and clocks that jump."""

import threading
import time

import numpy as np
import pytest

from ttscompile.errors import ExecutorError, StaleObservationError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.window import MOST_FRAMES

from .simulation import REAL_LIMIT, FakeClock, Quick, ScriptedPolicy, World, workers


def kept(executor: AsyncExecutor) -> int:
    """Frames that the window of an executor holds."""
    return len(executor._state._window._frames)


def test_four_cameras_at_10_khz_are_one_window_and_no_tick_is_missed() -> None:
    """In simulated time. Their frames take unlike times to come, and so are out of order."""
    delays = (0.0, 0.00015, 0.0004, 0.0022)
    with World() as world:
        for tick in range(14):
            for _ in range(100):  # milliseconds, with ten frames of each camera at once
                now = world.clock.now()
                for i in range(10):
                    for delay in delays:
                        world.executor.observe(world.frame(), now - delay - i * 0.0001)
                world.clock.advance(0.001)
            if tick > 2:
                world.executor.action()
            assert kept(world.executor) <= MOST_FRAMES
        counted = world.executor.statistics()
    assert (counted.frames, counted.frames_late) == (14 * 100 * 10 * 4, 0)
    assert (counted.starved, counted.holds, counted.deadlines_missed) == (0, 0, 0)
    assert counted.chunks == 2


def test_threads_that_observe_as_fast_as_they_can_starve_nobody() -> None:
    """In real time: no call waits for a frame that came, and no tick for the lock for long."""

    settings = ExecutorSettings(max_hold=1000, policy_hz=50)
    with AsyncExecutor(Quick(FakeClock()), 100, settings, latencies={"dense": 0.01}) as executor:
        stop, failures = threading.Event(), []

        def camera() -> None:
            try:
                while not stop.is_set():
                    executor.observe({"obs": np.zeros(2)})
            except ExecutorError as error:
                failures.append(error)

        threads = [threading.Thread(target=camera) for _ in range(4)]
        for thread in threads:
            thread.start()
        executor.action(timeout=REAL_LIMIT)
        for _ in range(30):
            executor.action()
            time.sleep(0.01)
        stop.set()
        for thread in threads:
            thread.join()
        counted = executor.statistics()
        assert failures == []
        assert counted.frames > MOST_FRAMES >= kept(executor)
        assert counted.chunks > 1
        time.sleep(0.2)  # what is scheduled runs out
        now = executor.now()
        for ago in (0.02, 0.0):
            executor.observe({"obs": np.zeros(2)}, now - ago)
        executor.action(timeout=REAL_LIMIT)  # its call was not forgotten: this would hold the last action else
        assert executor.statistics().holds == counted.holds


def test_a_clock_that_jumps_ahead_ends_what_is_scheduled_and_the_loop_goes_on_with_new_frames() -> None:
    with World() as world:
        world.run(10)
        world.clock.advance(3600.0)  # the machine slept, and the clock did not
        with pytest.raises(StaleObservationError, match="no complete observation window|is 3600 s old"):
            world.executor.action()
        assert (world.run(20)[:, 1] > 3600).all()
        assert world.executor.statistics().starved == 1


def test_a_clock_that_is_set_back_is_told_and_a_reset_begins_anew() -> None:
    """``time.monotonic`` never is; one that was injected may be."""
    with World() as world:
        world.run(10)
        world.clock._now -= 3600.0
        world.observe()
        assert world.executor.statistics().frames_late == 1
        with pytest.raises(ExecutorError, match="ticks before the last one that was given out. Times must not go back"):
            world.executor.action()
        world.executor.reset()
        assert (world.run(20)[:, 1] < -3500).all()


def test_the_time_of_day_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> float:
        raise AssertionError("time.time")

    monkeypatch.setattr(time, "time", fail)
    policy = ScriptedPolicy(FakeClock(), latency={"dense": 0.0})
    with AsyncExecutor(policy, 100, ExecutorSettings(max_hold=1000, max_age=REAL_LIMIT)) as executor:
        now = executor.now()
        for ago in (0.01, 0.0):
            executor.observe({"obs": np.zeros(2)}, now - ago)
        executor.action(timeout=REAL_LIMIT)
        assert executor.statistics().calls > 0
    assert workers() == []
