"""The fault drill, observations: they stop, come late, out of order, or are wrong."""

from __future__ import annotations

import random

import numpy as np
import pytest

from ttscompile.errors import ObservationError, StaleObservationError
from ttscompile.runtimes.executor import ExecutorSettings

from .simulation import TA, World


def test_observations_that_stop_end_in_a_stale_observation() -> None:
    with World(settings=ExecutorSettings(max_hold=2)) as world:
        world.begin()
        made = []
        with pytest.raises(StaleObservationError, match=r"window is 1 s old, and may be 0\.3 s"):  # noqa: PT012
            for _ in range(100):
                made.append(world.tick(observe=False))
        assert len(made) == TA - 2 + 2  # what was left of the one chunk, and the holds
        assert len(world.policy.calls) == 1


def test_frames_that_are_too_old_start_no_call() -> None:
    with World(settings=ExecutorSettings(max_age=0.2)) as world:
        world.clock.advance(1.0)
        world.observe(at=0.68)
        world.observe(at=0.75)
        assert world.policy.calls == []
        with pytest.raises(
            StaleObservationError, match=r"newest complete observation window is 0\.25 s old, and may be 0\.2 s"
        ):
            world.executor.action()
        world.observe(at=0.9)
        world.observe(at=1.0)
        assert len(world.policy.calls) == 1


def test_late_frames_and_frames_out_of_order_still_make_windows() -> None:
    with World() as world:
        world.begin()
        order = random.Random(0)
        delayed: list[float] = []
        for _ in range(100):
            delayed.append(world.time)
            if len(delayed) == 2:
                order.shuffle(delayed)
                for at in delayed:
                    world.observe(at)
                delayed.clear()
            assert world.tick(observe=False) is not None
        for _, _, obs in world.policy.calls:
            assert obs[0, 1, 1] - obs[0, 0, 1] == pytest.approx(0.1)
        counted = world.executor.statistics()
    assert counted.starved == 0
    assert counted.frames == 102


def test_a_frame_that_comes_far_too_late_is_counted_and_left_out() -> None:
    with World() as world:
        world.begin()
        for _ in range(30):
            world.tick()
        world.observe(at=0.5)
        assert world.executor.statistics().frames_late == 1


def test_wrong_frames_are_the_callers_error_and_change_nothing() -> None:
    with World() as world:
        world.begin()
        for obs in (
            {"obs": np.zeros(3)},
            {"obs": np.array([0.0, np.nan])},
            {"image": np.zeros(2)},
            {"obs": np.zeros(2, int)},
        ):
            with pytest.raises(ObservationError):
                world.executor.observe(obs)
        with pytest.raises(ObservationError, match="5 s ahead of the executor's clock"):
            world.executor.observe(world.frame(), world.clock.now() + 5)
        with pytest.raises(ObservationError):
            world.executor.observe(world.frame(), float("nan"))
        for _ in range(20):
            assert world.tick() is not None
        assert world.executor.statistics().frames == 22
