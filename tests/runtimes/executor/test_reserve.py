"""What a chunk predicted beyond its horizon: it makes up for latency, and bridges chunks that come late."""

from itertools import pairwise

import numpy as np
import pytest

from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits

from .simulation import TA, FakeClock, ScriptedPolicy, World


def starts(world: World) -> list[int]:
    """Ticks between the calls, the first two apart."""
    times = [round((when - world.start) * world.hz) for when, _, _ in world.policy.calls]
    return [after - before for before, after in pairwise(times)][1:]


@pytest.mark.parametrize("seam", ["replace", "blend"])
@pytest.mark.parametrize("ticks_per_step", [1, 3])
@pytest.mark.parametrize(("latency", "margin"), [(0.02, 0), (0.1, 0), (0.2, 1), (0.28, 3), (0.6, 1)])
def test_calls_start_as_many_actions_apart_as_the_policy_executes(
    latency: float, margin: int, ticks_per_step: int, seam: str
) -> None:
    """However long they take, and whatever they are early by: later actions of the prediction are played for that."""
    policy = ScriptedPolicy(FakeClock(), {"dense": latency}, reserve=9)
    settings = ExecutorSettings(policy_hz=10.0, margin_ticks=margin, seam=seam)
    with World(10.0 * ticks_per_step, settings, policy) as world:
        made = world.run(60 * ticks_per_step)
        counted = world.executor.statistics()
        assert set(starts(world)) == {TA * ticks_per_step}
    later = made[2 * TA * ticks_per_step :]  # than the first chunk, which is played from its beginning
    first, last = (f([action[2] for action in later]) for f in (min, max))
    mixed = settings.blend_steps / ticks_per_step if seam == "blend" else 0  # with later ones of the chunk before
    assert first == pytest.approx(np.ceil(latency * 10 * ticks_per_step) // ticks_per_step + mixed, abs=1)
    assert last >= TA - 1
    assert last - first <= TA
    assert (counted.deadlines_missed, counted.reserve, counted.holds) == (0, 0, 0)


@pytest.mark.parametrize(("reserve", "apart"), [(9, 8), (3, 8), (2, 7), (1, 6), (0, 5)])
def test_calls_start_sooner_where_too_little_is_predicted(reserve: int, apart: int) -> None:
    """With calls of 1.9 ticks and a margin of 1 the next chunk is needed 11 ticks after the first, if it can wait."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.19}, reserve=reserve)
    with World(policy=policy, settings=ExecutorSettings(margin_ticks=1)) as world:
        world.run(60)
        assert set(starts(world)) == {apart}
        assert world.executor.statistics().deadlines_missed == 0


def test_no_more_is_planned_with_than_is_allowed() -> None:
    """reserve=0 never plays an action that the policy would not execute."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.19}, reserve=9)
    with World(policy=policy, settings=ExecutorSettings(reserve=0)) as world:
        made = world.run(60)
        assert max(action[2] for action in made) <= TA - 1
        assert set(starts(world)) == {5}


def test_a_late_chunk_is_bridged_by_what_the_last_one_predicted_beyond_its_horizon() -> None:
    policy = ScriptedPolicy(FakeClock(), fault={1: 1.0}, reserve=7)
    with World(policy=policy, settings=ExecutorSettings(max_hold=2)) as world:
        made, error = world.run_until_starved()
        counted = world.executor.statistics()
        assert "the last one was held for 2 ticks" in str(error)
        assert [action[2] for action in made[-6:]] == [TA + 3, TA + 4, TA + 5, TA + 6, TA + 6, TA + 6]
        assert (counted.reserve, counted.holds, counted.starved, counted.deadlines_missed) == (4, 2, 1, 1)
        assert counted.queue_depth is not None
        assert counted.queue_depth.min == 0


def test_a_chunk_that_comes_after_its_horizon_is_played_from_its_reserve() -> None:
    """Newer than what is left of the chunk before, and better than to hold; the deadline was missed all the same."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1, "fast": 0.05}, fault={1: 0.85}, reserve=9)
    settings = ExecutorSettings(tiers=("dense", "fast"), max_hold=0)
    with World(policy=policy, settings=settings) as world:
        ticks = world.run(40)
        counted = world.executor.statistics()
    assert max(action[2] for action in ticks) >= TA
    for number, action in enumerate(ticks):
        stood = 0.1 * (action[1] == ticks[0][1])  # before the first chunk
        assert action[1] + action[2] / 10 + stood == pytest.approx(ticks[0][1] + (ticks[0][2] + 1 + number) / 10)
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
        made, _ = world.run_until_starved()
        counted = world.executor.statistics()
    assert not np.any(made)
    assert (counted.chunks_refused, counted.reserve) == (0, 0)


def test_a_reserve_in_hand_is_not_given_up_for_a_late_chunk_that_the_guard_refuses() -> None:
    """Nothing of the second chunk is left but its reserve, which jumps; the first one's is played to its end."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.3}, fault={1: 0.85}, reserve=12)
    policy.actions = lambda obs: np.full((21, 3), 0.0 if obs[-1, 1] < 0.3 else 5.0)
    with World(policy=policy, settings=ExecutorSettings(max_hold=0, guard=GuardLimits(max_step=1.0))) as world:
        made, error = world.run_until_starved()
        counted = world.executor.statistics()
    assert not np.any(made)
    assert counted.reserve == 7
    assert counted.chunks_refused >= 1
    assert "exceeds the limit" in str(error)
