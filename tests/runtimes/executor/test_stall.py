"""The watchdog: a policy that has stopped moving runs another plan for one call, and forgets what it went on from."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile import Affine
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.guard import StallRule, Watchdog
from ttscompile.runtimes.executor.settings import resolve

from .simulation import FakeClock, ScriptedPolicy, World, opened_meanwhile

AFTER = 2.0
SETTINGS = ExecutorSettings(tiers=("fast",), stall_after=AFTER, max_hold=0)


class Stalling(ScriptedPolicy):
    """Its plan ``fast`` stands still where it is; ``dense`` goes on by 1 within a chunk."""

    place, trembling = 0.0, 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.followed: list[int] = []
        self.forgot: list[int] = []  # number of the call that came after
        rng = np.random.default_rng(0)

        def answer(obs: np.ndarray) -> np.ndarray:
            before, moves = self.place, self.calls[-1][1] == "dense"
            self.place += moves
            ramp = before + np.linspace(0, 1, self.predicted) * moves
            return np.repeat(ramp[:, None], 3, axis=1) + self.trembling * rng.uniform(-1, 1, (self.predicted, 3))

        self.actions = answer

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.forgot.append(len(self.calls))

    def follow(self, executed: int) -> None:
        self.followed.append(len(self.calls))

    @property
    def plans(self) -> list[str]:
        return [plan for _, plan, _ in self.calls]


def policy(dense: float = 0.1, **given: object) -> Stalling:
    return Stalling(FakeClock(), {"fast": 0.05, "dense": dense}, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("seam", ["replace", "blend", "ensemble"])
def test_a_policy_that_has_stopped_runs_the_other_plan_once_and_is_given_as_long_again(seam: str) -> None:
    stalling = policy(reserve=4)
    with World(10.0, replace(SETTINGS, seam=seam), stalling) as world:
        made = world.run(120)
        counted = world.executor.statistics()
    stalls = [i for i, plan in enumerate(stalling.plans) if plan == "dense"]
    assert len(stalls) == counted.stalls >= 3
    assert stalling.forgot == [0, *stalls]  # reset before the first call, and before each of these
    assert set(stalling.resets) == {None}  # the sequence of the noise goes on
    assert not {*stalls} & {*stalling.followed} and len(stalling.followed) == len(stalling.plans) - len(stalls) - 1
    starts = [stalling.calls[i][0] for i in stalls]
    assert AFTER <= starts[0] - stalling.calls[0][0] <= AFTER + 1.2  # the next call after it
    assert all(after - before > AFTER for before, after in pairwise(starts))
    assert made[:, 0].max() > 2  # it gets away, again and again
    assert counted.deadlines_missed == counted.holds == 0
    assert counted.plan == "fast"


def test_nothing_happens_unless_it_is_asked_for() -> None:
    stalling = policy()
    with World(10.0, replace(SETTINGS, stall_after=None), stalling) as world:
        made = world.run(60)
        assert world.executor.statistics().stalls == 0
    assert set(stalling.plans) == {"fast"}
    assert stalling.forgot == [0]
    assert not made.any()


@pytest.mark.parametrize(("trembling", "stalls"), [(0.009, True), (0.03, False)])
def test_trembling_is_no_movement(trembling: float, stalls: bool) -> None:
    stalling = policy()
    stalling.trembling = trembling
    with World(10.0, replace(SETTINGS, stall_range=0.02), stalling) as world:
        world.run(60)
        assert (world.executor.statistics().stalls > 0) == stalls


def test_a_slow_plan_is_planned_with_and_costs_the_tiers_nothing() -> None:
    """0.45 s beside 0.05: with a reserve of 8 actions no deadline is missed, and with one of 2 a hold bridges it."""
    for reserve, missed in ((8, False), (2, True)):
        stalling = policy(dense=0.45, reserve=reserve)
        settings = replace(SETTINGS, tiers=("middle", "fast"), max_hold=3)
        stalling.latency["middle"] = 0.05
        stalling.info = replace(stalling.info, plans=("fast", "middle", "dense"))
        with World(10.0, settings, stalling) as world:
            world.run(45)
            counted = world.executor.statistics()
        assert counted.stalls == 1
        assert (counted.deadlines_missed, counted.holds > 0) == (int(missed), missed)
        starts = [round(10 * (after[0] - before[0])) for before, after in pairwise(stalling.calls)]
        assert missed or set(starts[1:]) == {8}  # what is predicted covers it: it starts when it always does
        assert (counted.starved, counted.switches_down, counted.plan) == (0, 0, "middle")


def test_the_reserve_and_a_hold_bridge_a_plan_that_is_too_slow_for_the_loop() -> None:
    stalling = policy(dense=1.1, reserve=2)
    with World(10.0, replace(SETTINGS, max_hold=9), stalling) as world:
        world.run(60)
        counted = world.executor.statistics()
        assert set(world.executor.feasibility()) == {"fast"}  # it is no tier
    assert counted.stalls >= 1
    assert counted.holds > 0 and counted.starved == 0
    assert stalling.place >= 1


def test_a_reset_and_a_mean_begin_with_nothing() -> None:
    """Still for 1.5 s, a reset, still for 1.5 s: no stall. Nor is the chunk of a stall averaged with those before."""
    stalling = policy()
    with World(10.0, SETTINGS, stalling) as world:
        for _ in range(2):
            world.run(14)
            world.executor.reset()
            world.episode += 1
        assert world.executor.statistics().stalls == 0
    stalling = policy(dense=0.05, reserve=4)
    with World(10.0, replace(SETTINGS, seam="ensemble", horizon=1), stalling) as world:
        made = world.run(25)[:, 0]
    assert made[made > 0][0] == pytest.approx(2 / (stalling.predicted - 1))  # of that chunk, a tick after its frame


def test_its_call_stands_in_the_trace() -> None:
    with World(10.0, SETTINGS, policy()) as world:
        world.run(40)
        events = world.executor.trace.to_json()["traceEvents"]
    calls = [event["args"] for event in events if event["name"] == "inference"]
    assert [call["plan"] for call in calls if "stalled" in call] == ["dense"]
    assert all("stalled" not in call for call in calls if call["plan"] == "fast")


@given(st.lists(st.tuples(st.floats(-0.125, 0.125, width=32), st.floats(-1, 1, width=32)), min_size=1, max_size=60))
def test_the_actions_since_the_first_are_within_reach_of_it(actions: list[tuple[float, float]]) -> None:
    dog = Watchdog(StallRule(5, np.array([0.05, 0.9], np.float32), "dense"))
    rows, first = np.array(actions, np.float32), 0
    for i, row in enumerate(rows):
        before = dog.plan
        changed = dog.give(row)
        if (np.abs(row - rows[first]) > [np.float32(0.05), np.float32(0.9)]).any():
            first = i
        assert dog.plan == ("dense" if i - first >= 5 else None)
        assert changed == (dog.plan != before)
    dog.restart()
    assert dog.plan is None
    assert not any(Watchdog(None).give(row) for row in rows)


def test_the_reach_is_in_normalised_units() -> None:
    info = policy().info
    made = resolve(replace(SETTINGS, stall_range=0.5), info, 20.0)
    assert made.stall is not None
    assert (made.stall.ticks, made.stall.reach.tolist(), made.stall.plan) == (40, [0.5] * 3, "dense")
    assert made.plans == ("fast", "dense")
    normalizer = Affine(np.array([0.5, -0.1, 2.0]), np.zeros(3, np.float32))
    made = resolve(
        replace(SETTINGS, stall_range=0.5), replace(info, action=replace(info.action, normalizer=normalizer)), 20.0
    )
    assert made.stall is not None
    np.testing.assert_allclose(made.stall.reach, [1, 5, 0.25], rtol=1e-6)
    assert resolve(replace(SETTINGS, stall_after=None, stall_plan="slow"), info, 20.0).plans == (
        "fast",
    )  # nobody looks


def test_its_latency_has_to_be_known_or_is_measured() -> None:
    stalling = policy()
    with pytest.raises(
        ExecutorError, match=r"latencies lacks the plan 'dense'; give one for each of \('fast', 'dense'\)"
    ):
        AsyncExecutor(stalling, 10.0, SETTINGS, clock=stalling.clock, latencies={"fast": 0.05})
    opened_meanwhile(stalling, SETTINGS).close()
    assert stalling.plans.count("fast") == stalling.plans.count("dense") == SETTINGS.warm_up + SETTINGS.measured_calls
