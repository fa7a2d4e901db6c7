"""Policies that begin with their last chunk: what they are told of it, and what their calls from nothing take."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ttscompile import Plan
from ttscompile.errors import DeadlineMissedError, ExecutorError, InfeasibleError
from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits
from ttscompile.runtimes.executor.feasibility import fast_enough
from ttscompile.runtimes.executor.measure import measure_latencies
from ttscompile.runtimes.executor.settings import NO_CHUNK, resolve

from .simulation import TA, FakeClock, Following, World


@pytest.mark.parametrize("ahead", [0.0, 0.2])
@pytest.mark.parametrize("ticks_per_step", [1, 2])
@pytest.mark.parametrize("reserve", [0, TA])
@pytest.mark.parametrize("stood", [0, 2, 5, 30])
def test_it_is_told_how_many_of_its_actions_were_given_out(
    stood: int, reserve: int, ticks_per_step: int, ahead: float
) -> None:
    """None while the robot stands still, however long; then those from the frame of a call to that of the next."""
    policy = Following(FakeClock(), {"dense": 0.2}, reserve=reserve)
    given_for: list[float] = []
    with World(10.0 * ticks_per_step, ExecutorSettings(policy_hz=10.0), policy) as world:
        for tick in range(60 * ticks_per_step):
            world.observe()
            if world.executor.ready and tick >= stood * ticks_per_step:
                given_for.append(world.time + ahead)
                world.executor.action(world.start + given_for[-1])
            world.clock.advance(1 / world.hz)
        assert world.executor.statistics().deadlines_missed == 0
    frames = [obs[0, -1, 1] - 1e-6 for _, _, obs in policy.calls]
    given_out = [sum(before <= time < after for time in given_for) for before, after in pairwise(frames)]
    assert policy.followed == {i: round(n / ticks_per_step) for i, n in enumerate(given_out, 1)}
    last = policy.followed[len(given_out)]
    assert last == TA if reserve else 0 < last < TA


@pytest.mark.parametrize(("fault", "outcome"), [("nan", "refused"), (1.0, "overdue"), (None, "refused")])
def test_it_does_not_go_on_with_a_chunk_that_was_not_played(fault: str | float | None, outcome: str) -> None:
    policy = Following(
        FakeClock(), fault={} if fault is None else {2: fault}, reserve=0 if outcome == "overdue" else TA
    )
    limits = GuardLimits()
    if fault is None:  # it jumps
        limits = GuardLimits(max_step=5.0)
        policy.actions = lambda obs: np.full((policy.predicted, 3), 9.0 * (len(policy.calls) == 3))
    with World(settings=ExecutorSettings(guard=limits), policy=policy) as world:
        world.begin()
        while len(policy.calls) < 6:
            try:
                world.tick()
            except DeadlineMissedError:
                world.clock.advance(0.1)
        counted = world.executor.statistics()
    assert getattr(counted, f"chunks_{outcome}") == 1
    assert policy.followed.pop(3) == NO_CHUNK
    assert list(policy.followed) == [1, 2, 4, 5] and max(policy.followed.values()) <= TA


def test_a_chunk_of_the_episode_before_is_not_spoken_of() -> None:
    policy = Following(FakeClock(), {"dense": 0.3}, reserve=TA)
    with World(policy=policy) as world:
        world.begin()
        while len(policy.calls) < 3:  # and during that call
            world.tick()
        world.executor.reset()
        world.episode = 1
        world.run(20)
        assert world.executor.statistics().chunks_discarded == 1
    assert policy.followed == {1: TA, 2: TA, 4: TA, 5: TA}


class Warm(Following):
    """A call that has a chunk to begin with takes 50 ms; one that has none takes its ``latency``."""

    plans: Any = None

    def reset(self, seed: int | None = None) -> None:
        self.follow(NO_CHUNK)

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        if self.followed.get(len(self.calls)) != NO_CHUNK:
            self.fault[len(self.calls)] = 0.05
        return super().predict_action(obs_dict, plan=plan)


@pytest.mark.parametrize("measured_calls", [1, 5])
@pytest.mark.parametrize(("cold", "feasible"), [(0.6, True), (0.9, False)])
def test_its_calls_from_nothing_have_to_be_fast_enough_too(cold: float, feasible: bool, measured_calls: int) -> None:
    """One that is late leads to another one."""
    policy = Warm(FakeClock(), {"warm": cold}, reserve=TA)
    settings = resolve(ExecutorSettings(measured_calls=measured_calls), policy.info, 10.0)
    policy.reset()
    (times,) = measure_latencies(policy, policy.clock, settings).values()
    assert times.ms == pytest.approx([1e3 * cold, 50, 50, 1e3 * cold, 50][:measured_calls])
    judged = {"warm": settings.feasibility(max(times.ms) / 1e3)}
    if feasible:
        assert fast_enough(judged, refuse=True) == ("warm",)
    else:
        with pytest.raises(InfeasibleError, match="2 x latency 900"):
            fast_enough(judged, refuse=True)


@pytest.mark.parametrize("known_by", ["info", "plans"])
def test_a_horizon_after_which_it_would_never_begin_with_a_chunk_is_refused(known_by: str) -> None:

    def opened(horizon: int, *tiers: str) -> World:
        policy = Warm(FakeClock(), {"warm": 0.05, "full": 0.1}, reserve=TA)
        if known_by == "info":
            vars(policy.info).update(follows=True)
        else:
            policy.plans = {"warm": Plan(otherwise=Plan()), "full": Plan()}
            vars(policy.info).update(default_plan="full")
        return World(settings=ExecutorSettings(horizon=horizon, tiers=tiers), policy=policy)

    message = rf"horizon = {TA + 1}: plan 'warm' begins with the chunk .* than the policy's {TA} actions. Give at most"
    with pytest.raises(ExecutorError, match=message):
        opened(TA + 1, "full", "warm")
    for horizon, tiers in ((TA, ("full", "warm")), (TA + 1, ("full",))):
        with opened(horizon, *tiers) as world:
            world.begin()
