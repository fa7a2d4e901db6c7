"""The executor with its real thread, on a clock that the test advances."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from ttscompile.core.spec import Affine, ObservationSpec
from ttscompile.errors import (
    DeadlineMissedError,
    ExecutorClosedError,
    ExecutorError,
    InfeasibleError,
    TtscompileError,
    WorkerDeadError,
)
from ttscompile.runtimes.arrays import check_observation
from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits
from ttscompile.runtimes.executor.measure import some_observation

from .simulation import REAL_LIMIT, TA, FakeClock, ScriptedPolicy, Told, World, opened_meanwhile


def test_every_tick_has_the_action_for_its_time() -> None:
    """The robot stands still until the first chunk is there: that one has its actions as much later."""
    with World() as world:
        world.begin()
        first = world.policy.calls[0][2][0, -1, 1]
        for _ in range(60):
            now = world.time
            episode, seen, index = world.tick()
            assert episode == 0
            stood = 0.1 if seen == np.float32(first) else 0.0
            assert seen + index / world.hz == pytest.approx(now - stood, abs=1e-3)
            assert 0 <= index < TA
        counted = world.executor.statistics()
    assert (counted.ticks, counted.holds, counted.starved, counted.deadlines_missed) == (61, 0, 0, 0)
    assert counted.frames_early == 0, "a policy without pieces for frames is asked for none"
    assert counted.chunks == counted.calls == len(world.policy.calls)
    assert counted.latency_ms is not None and counted.latency_ms.p50 == pytest.approx(100)


def test_calls_start_with_the_last_frame_that_comes_early_enough() -> None:
    """Actions for 0.8 s; latency and margin are 0.1 s each. A call at 0.6 s is on time to the tick, so 0.5 s it is.

    The first chunk begins when its call is done, 0.1 s after its frame.
    """
    with World() as world:
        world.run(60)
        starts = np.array([start for start, _, _ in world.policy.calls])
        counted = world.executor.statistics()
    np.testing.assert_allclose(np.diff(starts), [0.6, *[0.5] * (len(starts) - 2)], atol=1e-6)
    assert counted.slack_ms is not None and counted.observation_age_ms is not None
    assert (counted.slack_ms.min, counted.slack_ms.max) == pytest.approx((200, 200))
    assert counted.observation_age_ms.max == 0


def test_a_slow_start_plays_what_is_left_of_the_chunk() -> None:
    """Three actions are given out while a chunk is computed: it is played from its fourth on."""
    with World(latency={"dense": 0.25}) as world:
        seen = world.run(30)
    changes = [b[2] for a, b in pairwise(seen) if a[1] != b[1]]
    assert changes
    assert set(changes) <= {3.0, 4.0}  # 0.25 s of inference and one tick of margin
    assert world.executor.statistics().deadlines_missed == 0


def test_the_same_times_give_the_same_actions() -> None:
    def run() -> list[float]:
        with World(20, ExecutorSettings(policy_hz=10, seam="blend", interpolation="linear")) as world:
            return [float(x) for x in world.run(100).ravel()]

    assert run() == run()


@pytest.mark.parametrize(("interpolation", "expected"), [("hold", [0, 0, 1, 1, 2]), ("linear", [0, 0.5, 1, 1.5, 2])])
def test_a_faster_control_loop_holds_or_interpolates(interpolation: str, expected: list[float]) -> None:
    made = ExecutorSettings(policy_hz=10, interpolation=interpolation)
    with World(20, made, latency={"dense": 0.04}) as world:
        for _ in range(3):
            world.tick(action=False)
        frame = world.clock.now() - 0.05  # of the newest window
        index = [world.executor.action(frame + i / 20)[2] for i in range(5)]
    np.testing.assert_allclose(index, expected)


def test_action_waits_only_if_it_is_told_to() -> None:
    with World() as world:
        world.tick(action=False)
        world.observe()
        before = world.time
        with pytest.raises(DeadlineMissedError, match=r"under way for 0 s; the longest of the last ones took 0\.1 s"):
            world.executor.action()
        with pytest.raises(DeadlineMissedError):
            world.executor.action(timeout=0.05)
        assert world.time == pytest.approx(before + 0.05)
        assert world.executor.action(timeout=1.0) is not None
        assert world.time == pytest.approx(before + 0.1)


def test_ready_says_whether_an_episode_has_its_first_chunk() -> None:
    with World() as world:
        seen = []
        for _ in range(2):
            for _ in range(4):
                world.observe()
                seen.append(world.executor.ready)
                if seen[-1]:
                    assert world.executor.action()[0] == world.episode
                world.clock.advance(0.1)
            world.executor.reset()
            world.episode += 1
    assert seen == 2 * [False, False, True, True]
    with World(fault={0: "raise"}) as world, pytest.raises(WorkerDeadError):  # noqa: PT012
        world.tick(action=False)
        world.observe()
        world.clock.advance(1.0)
        world.executor.ready  # noqa: B018


def test_actions_are_the_callers_own() -> None:
    with World() as world:
        world.begin()
        now = world.clock.now()
        first = world.executor.action(now)
        expected = first.copy()
        first[:] = -1
        np.testing.assert_array_equal(world.executor.action(now), expected)


def test_frames_are_copied() -> None:
    with World() as world:
        mine = np.array([0.0, 0.0])
        for _ in range(2):
            world.executor.observe({"obs": mine})
            mine += 1
            world.clock.advance(0.1)
        np.testing.assert_array_equal(world.policy.calls[0][2][0], [[0, 0], [1, 1]])


def test_times_that_go_backwards_are_refused() -> None:
    with World() as world:
        world.begin()
        now = world.clock.now()
        world.executor.action(now + 0.3)
        with pytest.raises(ExecutorError, match="3 ticks before the last one"):
            world.executor.action(now)


def test_reset_starts_an_episode_and_passes_the_seed_on() -> None:
    with World() as world:
        world.begin()
        world.executor.reset(seed=7)
        world.episode = 1
        with pytest.raises(DeadlineMissedError, match="0 of 2 frames"):
            world.executor.action()
        assert world.run(1)[0, 0] == 1
        assert world.policy.resets == [None, 7]
        assert world.executor.statistics().resets == 1


def test_a_seed_that_is_none_is_told_to_who_gave_it_and_the_policy_lives() -> None:
    with World() as world:
        world.begin()
        with pytest.raises(TtscompileError, match="seed must be an integer of at least 0"):
            world.executor.reset(seed=-1)
        assert world.executor.statistics().resets == 0
        world.tick()
        assert world.policy.resets == [None]


def test_the_prefix_seam_is_refused_for_a_policy_that_cannot_inpaint() -> None:
    with pytest.raises(
        ExecutorError, match=r"takes prefix= and inpaints it; ScriptedPolicy does not. Use seam='blend'"
    ):
        World(settings=ExecutorSettings(seam="prefix"))


@pytest.mark.parametrize("trained", [0, 2])
def test_the_prefix_seam_gives_the_policy_what_is_committed(trained: int) -> None:
    """Of a policy that was trained with a prefix no longer one, in a loop that knowingly asks for it."""

    policy = Told(FakeClock(), {"dense": 0.2})
    settings = ExecutorSettings(seam="prefix")
    if trained:
        vars(policy.info).update(trained_prefix=trained)
        with pytest.raises(InfeasibleError, match=r"latency 200 ms > 100 ms, of a prefix of 2 actions at 10 Hz"):
            World(settings=settings, policy=policy)
        policy.prefixes.clear()
        settings = replace(settings, refuse_infeasible=False)
    with World(settings=settings, policy=policy) as world:
        world.begin()
        played = {round(world.hz * world.time): world.tick() for _ in range(20)}
    assert policy.prefixes[0].shape == (0, 3)
    for (start, _, _), prefix in list(zip(policy.calls, policy.prefixes, strict=True))[1:3]:
        tick = round(world.hz * (start - world.start))
        assert prefix.shape == (trained or 3, 3)  # now, and the two ticks that the call will take
        np.testing.assert_array_equal(prefix[:2], [played[tick], played[tick + 1]])
        assert trained or prefix[2, 2] == prefix[1, 2] + 1


def test_what_is_asked_for_ahead_is_committed_too() -> None:
    """By the end of a call of two ticks the action of four ticks later has been given out."""
    policy = Told(FakeClock(), {"dense": 0.2}, reserve=TA)
    with World(settings=ExecutorSettings(seam="prefix"), policy=policy) as world:
        for _ in range(30):
            world.observe()
            if world.executor.ready:
                world.executor.action(world.clock.now() + 0.2)
            world.clock.advance(0.1)
    assert {len(prefix) for prefix in policy.prefixes[1:]} == {5}


@pytest.mark.parametrize("default", ["warm", "full"])
def test_the_prefix_seam_is_refused_for_plans_of_which_one_takes_none(default: str) -> None:
    """Whatever the default plan takes, and whether or not latencies are known."""

    class Some(Told):
        def prefix_refusal(self, plan: str) -> str | None:
            return "it keeps to it." if plan == "warm" else None

    def opened(*tiers: str, stall_after: float | None = None) -> World:
        policy = Some(FakeClock(), {"full": 0.1, "warm": 0.1})
        vars(policy.info).update(default_plan=default, prefix_refusal="it keeps to it." if default == "warm" else None)
        made = ExecutorSettings(seam="prefix", tiers=tiers or None, stall_after=stall_after, stall_plan="warm")
        return World(settings=made, policy=policy)

    for tiers, stall_after in ((("full", "warm"), None), (("full",), 1.0), *([((), None)] * (default == "warm"))):
        with pytest.raises(ExecutorError, match="plan 'warm' of this one does not: it keeps to it. Use seam='blend'"):
            opened(*tiers, stall_after=stall_after)
    with opened("full") as world:
        world.begin()
        assert len(world.run(20)) == 20


def test_what_is_infeasible_is_refused_with_the_arithmetic() -> None:
    with pytest.raises(
        InfeasibleError,
        match=r"100 \+ 2 x latency 400 \+ margin 100 = 1000 ms > 800 ms = 8 actions at 10 Hz.*at most 300 ms",
    ):
        World(latency={"dense": 0.4})
    assert threading.active_count() == len(threading.enumerate())
    with World(latency={"dense": 0.4, "fast": 0.1}, settings=ExecutorSettings(tiers=("dense", "fast"))) as world:
        assert world.executor.statistics().plan == "fast"
        assert not world.executor.feasibility()["dense"].feasible


def test_latencies_are_measured_if_they_are_not_given_and_warm_up_does_not_count() -> None:
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1}, fault={0: 5.0, 1: 3.0})
    executor = opened_meanwhile(policy)
    executor.close()
    assert executor.feasibility()["dense"].latency == pytest.approx(0.1, abs=0.02)
    assert len(policy.calls) == 7
    assert policy.resets[0] is None  # before measuring; the reset after it comes with the first episode


def test_latencies_are_measured_with_what_the_policy_takes() -> None:
    """Zeros would be no token, and a mask that leaves nothing: what attends to nothing gives no numbers."""
    specs = {
        "task": ObservationSpec((3,), dtype="int64", window=False, bounds=(1.0, 5.0)),
        "mask": ObservationSpec((8,), dtype="bool", window=False, bounds=(0.0, 1.0)),
        "image": ObservationSpec((2, 3, 4, 4), bounds=(0.5, 1.0)),
        "obs": ObservationSpec((2, 3), Affine(np.full(3, 2.0), np.full(3, -1.0))),
    }
    made = check_observation(some_observation(specs), specs)
    assert made["mask"].any()
    assert all((made[key] == again).all() for key, again in some_observation(specs).items())


def test_a_closed_executor_says_so() -> None:
    with World() as world:
        world.begin()
    for use in (world.executor.action, world.executor.reset, lambda: world.executor.observe(world.frame())):
        with pytest.raises(ExecutorClosedError):
            use()
    world.executor.close()
    assert (world.executor.statistics().chunks, world.executor.statistics().frames) == (1, 2)


def test_the_guard_refuses_and_the_loop_goes_on_with_what_it_has() -> None:
    limits = GuardLimits(low=-1, high=[10, 3, 20])  # channel 1 is the time of the observation
    with World(settings=ExecutorSettings(guard=limits, max_hold=2)) as world:
        refused = r"the guard refused the last chunk: action 0, channel 1, is 3\.\d"
        with pytest.raises(DeadlineMissedError, match=refused):
            world.run(60)
        counted = world.executor.statistics()
        assert counted.chunks_refused > 0
        assert counted.holds == 2
        assert "the bounds are -1 to 3" in str(counted.last_refusal)


def test_a_policys_thread_is_pinned() -> None:
    import os

    cores: list[set[int]] = []

    class Looking(ScriptedPolicy):
        def reset(self, seed: int | None = None) -> None:
            cores.append(os.sched_getaffinity(0))

    own = os.sched_getaffinity(0)
    with World(settings=ExecutorSettings(cores=(min(own),)), policy=Looking(FakeClock())):
        pass
    assert cores == [{min(own)}]
    assert os.sched_getaffinity(0) == own
    with pytest.raises(ExecutorError, match=r"cannot be pinned to \(4096,\)"):
        World(settings=ExecutorSettings(cores=(4096,)))


@pytest.mark.parametrize(
    "runtime", ["onnxruntime", *(pytest.param(name, marks=pytest.mark.compiles) for name in ("torch", "reference"))]
)
def test_it_runs_the_compiled_policy_on_every_runtime(toy_compiled: Path, runtime: str) -> None:
    """In real time, on a machine that may be busy: deadlines are not what this is about."""
    policy = ttscompile.load(toy_compiled, runtime=runtime, seed=0)
    settled = ExecutorSettings(guard=GuardLimits(low=-1e6, high=1e6), max_hold=1000, refuse_infeasible=False)
    limit = time.monotonic() + REAL_LIMIT
    with ttscompile.AsyncExecutor(policy, 20, settled) as executor:
        while executor.statistics().chunks < 3:
            assert time.monotonic() < limit
            executor.observe({"obs": np.array([0.5, -0.5], np.float32)})
            action = executor.action(timeout=5.0)
            assert action.shape == (2,) and np.isfinite(action).all()
            time.sleep(0.05)
    assert {"tick", "inference", "prologue", "decode"} <= {e["name"] for e in executor.trace.to_json()["traceEvents"]}
    policy.reset()  # it is the caller's again
    assert policy.predict_action({"obs": np.zeros((1, 2), np.float32)})["action"].shape == (1, 2, 2)


def test_the_executor_needs_nothing_but_numpy() -> None:
    code = (
        "import sys, ttscompile; ttscompile.AsyncExecutor, ttscompile.ExecutorSettings; import numpy;"
        "found = {name.partition('.')[0] for name in sys.modules};"
        "print(sorted(found & {'onnxruntime', 'torch', 'websockets', 'asyncio', 'click'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
