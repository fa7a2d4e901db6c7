"""The fault drill: everything that goes wrong in the field, injected."""

import contextlib
import random
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ttscompile.core.spec import Affine
from ttscompile.errors import (
    DeadlineMissedError,
    ExecutorClosedError,
    ExecutorError,
    NonFiniteActionsError,
    StaleObservationError,
    WorkerDeadError,
)
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, GuardLimits

from .simulation import REAL_LIMIT, TA, FakeClock, ScriptedPolicy, World, workers

KNOWINGLY_SLOW = ExecutorSettings(refuse_infeasible=False, max_hold=2)


def test_inference_slower_than_the_horizon_holds_and_then_raises_and_says_why() -> None:
    with World(latency={"dense": 1.5}, settings=KNOWINGLY_SLOW) as world:
        for _ in range(2):
            world.tick(action=False)
        with pytest.raises(
            DeadlineMissedError, match=r"has been under way for 0\.3 s; the longest of the last ones took 1\.5"
        ):
            world.executor.action(timeout=0.2)
        for _ in range(100):
            try:
                world.tick()
            except DeadlineMissedError:
                world.clock.advance(0.1)
        counted = world.executor.statistics()
    assert counted.chunks == 0  # its actions are for a time that is over
    assert counted.chunks_overdue > 3
    assert counted.starved > 90


def test_a_gap_holds_the_last_action_for_a_bounded_number_of_ticks() -> None:
    with World(latency={"dense": 0.1}, fault={1: 1.0}, settings=ExecutorSettings(max_hold=3)) as world:
        made, error = world.run_until_starved()
        counted = world.executor.statistics()
        assert "the last one was held for 3 ticks" in str(error)
        assert not isinstance(error, StaleObservationError)
        np.testing.assert_array_equal(made[-4:], [made[-4]] * 4)
        assert made[-4][2] == TA - 1
        assert (counted.holds, counted.starved, counted.deadlines_missed) == (3, 1, 1)
        while world.executor.statistics().chunks < 2:  # the call ends, and the loop goes on
            world.tick(action=False)
        for _ in range(20):
            world.tick()
        assert world.executor.statistics().deadlines_missed == 1


def test_a_hold_of_nothing_raises_at_once() -> None:
    with World(fault={1: 1.0}, settings=ExecutorSettings(max_hold=0)) as world:
        made, _ = world.run_until_starved()
        assert made[-1][2] == TA - 1
        assert world.executor.statistics().holds == 0


def test_a_call_that_hangs_raises_in_time_and_the_executor_recovers_if_it_ends() -> None:
    with World(fault={1: "hang"}, settings=ExecutorSettings(max_hold=2)) as world:
        _, error = world.run_until_starved()
        assert "has been under way for" in str(error)
        with pytest.raises(DeadlineMissedError):
            world.executor.action(timeout=5.0)  # a declared timeout ends, too
        before = world.time
        world.policy.release()
        world.clock.settle()
        world.begin()
        assert world.tick()[1] >= before  # nothing that the hanging call computed
        assert world.executor.statistics().chunks_overdue == 1


def test_closing_while_a_call_hangs_says_so_and_leaves_when_it_ends() -> None:
    with World(fault={0: "hang"}) as world:
        for _ in range(3):
            world.tick(action=False)
        with pytest.raises(ExecutorError, match="still in a call, 0.05 s after close"):
            world.executor.close(timeout=0.05)
        with pytest.raises(ExecutorClosedError):
            world.executor.action()
        world.policy.release()
        world.executor.close(timeout=REAL_LIMIT)


def test_closing_during_inference_waits_for_it() -> None:
    world = World()
    for _ in range(2):
        world.tick(action=False)
    assert len(world.policy.calls) == 1
    closer = threading.Thread(target=world.executor.close)
    closer.start()
    world.clock.advance(0.2)
    closer.join(REAL_LIMIT)
    assert not closer.is_alive()
    assert len(world.policy.calls) == 1


def test_closing_wakes_whoever_waits_for_an_action() -> None:
    """In real time: the caller must not sit out its timeout."""
    policy = ScriptedPolicy(FakeClock())
    executor = AsyncExecutor(policy, 10, latencies={"dense": 0.1})
    caught: list[BaseException] = []

    def wait() -> None:
        try:
            executor.action(timeout=REAL_LIMIT)
        except ExecutorError as error:
            caught.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    time.sleep(0.05)
    executor.close()
    waiter.join(1.0)
    assert [type(each) for each in caught] == [ExecutorClosedError]


def test_an_exception_in_the_policy_is_raised_at_the_next_call_of_anybody() -> None:
    with World(fault={1: "raise"}) as world:
        with pytest.raises(WorkerDeadError, match="ZeroDivisionError: scripted") as caught:
            world.run(30)
        assert isinstance(caught.value.__cause__, ZeroDivisionError)
        for use in (world.executor.action, world.executor.reset, world.observe):
            with pytest.raises(WorkerDeadError):
                use()
        assert workers() == []


def test_an_exception_wakes_whoever_waits() -> None:
    with World(fault={0: "raise"}) as world:
        world.tick(action=False)
        world.observe()
        before = world.time
        with pytest.raises(WorkerDeadError):
            world.executor.action(timeout=10.0)
        assert world.time - before < 1


def test_an_error_that_nobody_was_told_is_raised_by_close_and_only_once() -> None:
    world = World(fault={0: "raise"})
    for _ in range(3):
        try:
            world.tick(action=False)
        except WorkerDeadError:  # told: so that close has nothing left to say
            break
    world.executor.close()
    quiet = World(fault={0: "raise"})
    quiet.tick(action=False)
    quiet.observe()
    quiet.clock.advance(1.0)
    with pytest.raises(WorkerDeadError, match="scripted"):
        quiet.executor.close()
    quiet.executor.close()


@pytest.mark.filterwarnings("ignore:closing the executor failed too")
def test_an_error_under_way_is_not_hidden_by_the_error_of_closing() -> None:
    with pytest.raises(KeyError) as caught, World(fault={0: "raise"}).executor as executor:  # noqa: PT012
        clock: FakeClock = executor._clock  # type: ignore[assignment]
        for at in (0.0, 0.1):
            executor.observe({"obs": np.array([0.0, at])})
            clock.advance(0.1)
        raise KeyError("mine")
    if sys.version_info >= (3, 11):  # before it a warning says so
        assert "ZeroDivisionError" in caught.value.__notes__[0]


def test_a_prediction_of_the_wrong_shape_is_an_error() -> None:
    with (
        World(fault={0: "shape"}) as world,
        pytest.raises(WorkerDeadError, match=r"shape \[1, 4, 3\]; expected \[1, T, Da\]"),
    ):
        world.begin()


@pytest.mark.parametrize(("raises", "wrong"), [(False, 1), (True, 3 * TA)])
def test_nan_is_not_executed(raises: bool, wrong: int) -> None:
    """A compiled policy raises where its arithmetic overflowed: the thread goes on, and so does the robot."""
    policy = ScriptedPolicy(FakeClock())

    def overflow(obs: np.ndarray) -> np.ndarray:
        chunk = np.zeros((policy.predicted, 3))
        if len(policy.calls) in (2, 3, 4):
            chunk[3, 1] = np.nan
            if raises:
                raise NonFiniteActionsError("scripted")
        return chunk

    policy.actions = overflow
    with World(policy=policy) as world:
        assert np.isfinite(world.run(30)).all()
        counted = world.executor.statistics()
        assert (counted.chunks_refused, counted.starved) == (3, 0)
        assert counted.last_refusal == f"{wrong} of its {3 * TA} numbers are not finite"


def test_nothing_but_nan_ends_in_an_error_that_says_so() -> None:
    with World(fault=dict.fromkeys(range(1, 100), "nan")) as world:
        _, error = world.run_until_starved()
        assert "the guard refused the last chunk: 1 of its" in str(error)


def test_a_jump_at_the_seam_is_refused() -> None:
    """The second chunk jumps: with a limit on steps it is refused, and the first one plays to its end."""
    policy = ScriptedPolicy(FakeClock())
    policy.actions = lambda obs: np.full((16, 3), 0.0 if obs[-1, 1] < 0.3 else 5.0)
    with World(policy=policy, settings=ExecutorSettings(guard=GuardLimits(max_step=1.0))) as world:
        made, error = world.run_until_starved()
        assert "its step of 5 in channel 0 exceeds the limit of 1" in str(error)
        assert not np.any(made)


@pytest.mark.parametrize("ranged", [True, False])
def test_only_a_normaliser_that_knows_the_range_of_the_actions_bounds_them(ranged: bool) -> None:
    """By mean and deviation, an action five deviations out is rare; by range it was never seen in training."""
    policy = ScriptedPolicy(FakeClock())
    ones = np.ones(3, np.float32)
    chunk = replace(policy.info.action, normalizer=Affine(ones, 0 * ones), ranged=ranged)
    policy.info = replace(policy.info, action=chunk)
    policy.actions = lambda obs: np.full((16, 3), 5.0)
    with World(policy=policy) as world:
        if ranged:
            with pytest.raises(DeadlineMissedError, match="the bounds are -1.1 to 1.1"):
                world.begin()
        else:
            assert (world.run(1) == 5).all()


def test_reset_during_inference_a_hundred_times_at_random_moments() -> None:
    chance = random.Random(1)
    with World(latency={"dense": 0.28}) as world:
        during = set()
        for episode in range(1, 101):
            for _ in range(chance.randrange(2, 12)):
                world.observe()
                try:
                    action = world.executor.action()
                    assert action[0] == world.episode
                except DeadlineMissedError:
                    pass
                world.clock.advance(0.1)
            world.clock.advance(chance.random() * 0.1)
            calls = len(world.policy.calls)
            world.executor.reset()
            world.episode = episode
            if world.executor.statistics().calls < calls:
                during.add(calls)
            assert len(world.policy.calls) == calls
        assert world.run(1)[0, 0] == 100
        counted = world.executor.statistics()
        assert len(during) > 50
        assert counted.chunks_discarded == len(during)
        assert counted.resets == 100


def test_a_reset_before_a_call_reaches_the_policy_before_that_call() -> None:
    order: list[str] = []

    class Noting(ScriptedPolicy):
        def reset(self, seed: int | None = None) -> None:
            order.append(f"reset {seed}")

        def predict_action(self, obs_dict: Any, *, plan: str) -> Any:
            order.append(f"call {obs_dict['obs'][0, -1, 0]:.0f}")
            return super().predict_action(obs_dict, plan=plan)

    with World(policy=Noting(FakeClock())) as world:
        world.run(5)
        assert order == ["reset None", "call 0", "call 0"]  # the second one is under way
        for seed in (3, None):
            world.executor.reset(seed)
        world.episode = 1
        world.begin()
    assert order == ["reset None", "call 0", "call 0", "reset 3", "call 1"]


def test_pressure_leads_to_the_faster_plan_and_back() -> None:
    settings = ExecutorSettings(tiers=("dense", "fast"), up_after=4)
    with World(latency={"dense": 0.25, "fast": 0.05}, fault={2: 0.9, 3: 0.1}, settings=settings) as world:
        world.begin()
        plans = set()
        for _ in range(120):
            try:
                world.tick()
            except DeadlineMissedError:
                world.clock.advance(0.1)
            plans.add(world.executor.statistics().plan)
        counted = world.executor.statistics()
        ran = [plan for _, plan, _ in world.policy.calls]
    assert plans == {"dense", "fast"}
    assert ran[:3] == ["dense"] * 3
    assert ran[3:7] == ["fast"] * 4
    assert ran[7] == "dense"
    assert (counted.switches_down, counted.switches_up) == (1, 1)


def test_a_late_call_leads_to_the_faster_plan_though_its_chunk_is_refused() -> None:
    settings = ExecutorSettings(tiers=("dense", "fast"))
    with World(latency={"dense": 0.25, "fast": 0.05}, fault={2: 0.9}, settings=settings) as world:
        world.policy.actions = lambda _: np.full((1 + 8, 3), np.nan if len(world.policy.calls) == 3 else 0)
        world.executor.observe({"obs": np.zeros(2)})
        while len(world.policy.calls) < 4:
            world.clock.advance(0.1)
            world.executor.observe({"obs": np.zeros(2)})
            with contextlib.suppress(DeadlineMissedError):
                world.executor.action()
        counted = world.executor.statistics()
        ran = [plan for _, plan, _ in world.policy.calls]
    assert (counted.chunks_refused, counted.switches_down) == (1, 1)
    assert ran == ["dense", "dense", "dense", "fast"]


@pytest.mark.alone
def test_two_threads_may_observe_and_act() -> None:
    """In real time: a camera at 200 Hz on one thread, a control loop at 100 Hz on another."""

    class Quick(ScriptedPolicy):
        def predict_action(self, obs_dict: Any, *, plan: str) -> Any:
            time.sleep(0.005)
            chunk = np.zeros((1, 16, 3)) + obs_dict["obs"][0, -1, 0]
            return {"action_pred": chunk}

    executor = AsyncExecutor(
        Quick(FakeClock()), 100, ExecutorSettings(max_hold=1000, policy_hz=50), latencies={"dense": 0.01}
    )
    stop, failures = threading.Event(), []

    def camera() -> None:
        try:
            while not stop.wait(0.005):
                executor.observe({"obs": np.zeros(2)})
        except ExecutorError as error:
            failures.append(error)

    thread = threading.Thread(target=camera)
    with executor:
        thread.start()
        before = time.monotonic()
        executor.action(timeout=REAL_LIMIT)
        assert time.monotonic() - before < REAL_LIMIT / 4  # woken by the chunk, not by the timeout
        for _ in range(50):
            assert not executor.action().any()
            time.sleep(0.01)
        stop.set()
        thread.join()
    assert failures == []
    assert executor.statistics().chunks > 3
