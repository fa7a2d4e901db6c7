"""What is played when a chunk comes late: the reserve that the one before it predicted beyond its horizon."""

from __future__ import annotations

import numpy as np
import pytest

from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits

from .simulation import TA, FakeClock, ScriptedPolicy, World


def test_a_late_chunk_is_bridged_by_what_the_last_one_predicted_beyond_its_horizon() -> None:
    policy = ScriptedPolicy(FakeClock(), fault={1: 1.0}, reserve=4)
    with World(policy=policy, settings=ExecutorSettings(max_hold=2)) as world:
        world.begin()
        made, error = world.run_until_starved()
        counted = world.executor.statistics()
        assert "the last one was held for 2 ticks" in str(error)
        assert [action[2] for action in made[-6:]] == [TA, TA + 1, TA + 2, TA + 3, TA + 3, TA + 3]
        assert (counted.reserve, counted.holds, counted.starved, counted.deadlines_missed) == (4, 2, 1, 1)
        assert counted.queue_depth is not None
        assert counted.queue_depth.min == 0


def test_a_chunk_that_comes_after_its_horizon_is_played_from_its_reserve() -> None:
    """Newer than what is left of the chunk before, and better than to hold; the deadline was missed all the same."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1, "fast": 0.05}, fault={1: 0.95}, reserve=7)
    settings = ExecutorSettings(tiers=("dense", "fast"), max_hold=0)
    with World(policy=policy, settings=settings) as world:
        world.begin()
        ticks = [world.tick() for _ in range(40)]
        counted = world.executor.statistics()
    assert max(action[2] for action in ticks) >= TA
    for number, action in enumerate(ticks):
        assert action[1] + action[2] / 10 == pytest.approx(ticks[0][1] + ticks[0][2] / 10 + number / 10)
    assert (counted.holds, counted.starved, counted.chunks_overdue) == (0, 0, 0)
    assert counted.deadlines_missed == 1
    assert counted.switches_down == 1


@pytest.mark.parametrize("bad", ["bounds", "step"])
def test_no_reserve_is_kept_that_the_guard_refuses(bad: str) -> None:
    """What is executed is fine, so it is executed; what comes after it is not there to be played."""
    policy = ScriptedPolicy(FakeClock(), fault={1: 1.0}, reserve=4)
    policy.actions = lambda obs: np.where(np.arange(16)[:, None] < 1 + TA + 2, 0.0, np.full((16, 3), 5.0))
    limits = GuardLimits(high=1.0, low=-1.0) if bad == "bounds" else GuardLimits(max_step=1.0)
    with World(policy=policy, settings=ExecutorSettings(max_hold=0, guard=limits)) as world:
        world.begin()
        made, _ = world.run_until_starved()
        counted = world.executor.statistics()
    assert not np.any(made)
    assert (counted.chunks_refused, counted.reserve) == (0, 0)


def test_a_reserve_in_hand_is_not_given_up_for_a_late_chunk_that_the_guard_refuses() -> None:
    """Nothing of the second chunk is left but its reserve, which jumps; the first one's is played to its end."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.3}, fault={1: 0.85}, reserve=7)
    policy.actions = lambda obs: np.full((16, 3), 0.0 if obs[-1, 1] < 0.3 else 5.0)
    with World(policy=policy, settings=ExecutorSettings(max_hold=0, guard=GuardLimits(max_step=1.0))) as world:
        world.begin()
        made, error = world.run_until_starved()
        counted = world.executor.statistics()
    assert not np.any(made)
    assert counted.reserve == 7
    assert counted.chunks_refused >= 1
    assert "exceeds the limit" in str(error)
