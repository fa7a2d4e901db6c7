"""Random schedules of everything that can happen, against a model of what may come out.

A short run is part of every test run; ``pytest tests/runtimes/executor -m soak`` runs at least 100,000 ticks.
"""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from ttscompile.errors import DeadlineMissedError, ExecutorClosedError, ObservationError, WorkerDeadError
from ttscompile.runtimes.executor import ExecutorSettings

from .simulation import TA, FakeClock, ScriptedPolicy, World, workers

HZ, MAX_HOLD, LATENCY = 10.0, 3, 0.12
HEALTHY = 2 * TA
"""Ticks of regular frames, without fault or reset, after which there has to be an action for every tick."""


class Schedule(RuleBasedStateMachine):
    """One executor after another; ``self.good`` counts ticks since something last went wrong."""

    ticks = 0
    last: tuple[int, np.ndarray] | None

    @initialize(
        seam=st.sampled_from(["replace", "blend", "ensemble"]),
        ticks_per_step=st.sampled_from([1, 2]),
        reserve=st.sampled_from([0, 5]),
    )
    def open(self, seam: str, ticks_per_step: int, reserve: int) -> None:
        made = ExecutorSettings(
            policy_hz=HZ,
            seam=seam,
            max_hold=MAX_HOLD,
            tiers=("dense", "fast"),
            up_after=3,
            trace_events=500,
            statistics_window=64,
        )
        self.seam = seam
        policy = ScriptedPolicy(FakeClock(), {"dense": LATENCY, "fast": LATENCY / 2}, reserve=reserve)
        self.world = World(HZ * ticks_per_step, made, policy)
        self.policy = policy
        self.good, self.held, self.last, self.stood = 0, 0, None, (0.0, 0.0)
        self.closed = False

    # What may happen

    @rule(count=st.integers(5, 60))
    def drive(self, count: int) -> None:
        for _ in range(count):
            missed = self.missed()
            self.observe(self.world.time)
            self.act(None)
            if self.good >= self.healthy and not self.died():
                assert self.missed() == missed, "a deadline was missed, although nothing was wrong for long enough"
            self.good += 1
            self.step()
            if self.died():
                return

    @rule(count=st.integers(1, 25))
    def lose_frames(self, count: int) -> None:
        for _ in range(count):
            self.good = 0
            self.act(None)
            self.step()

    @rule(count=st.integers(1, 10))
    def skip_actions(self, count: int) -> None:
        for _ in range(count):
            self.observe(self.world.time)
            self.step()
            self.good = 0

    @rule(back=st.lists(st.floats(0, 1.5), min_size=1, max_size=5))
    def observe_late_and_out_of_order(self, back: list[float]) -> None:
        self.good = 0
        for seconds in back:
            self.observe(max(self.world.time - seconds, 0.0))

    @rule(share=st.floats(0, 1))
    def drift(self, share: float) -> None:
        """The control loop is late by a part of a tick."""
        self.good = 0
        self.world.clock.advance(share / self.world.hz)
        assert len(workers()) <= 1

    @rule(timeout=st.floats(0, 1))
    def wait_for_an_action(self, timeout: float) -> None:
        before = self.world.clock.now()
        self.good = 0
        self.act(timeout)
        assert self.world.clock.now() <= before + timeout + 1e-9, "a declared timeout did not end"

    @rule(what=st.sampled_from(["shape", "nan", "future", "keys"]))
    def give_a_wrong_frame(self, what: str) -> None:
        at = self.world.clock.now()
        obs = {"shape": np.zeros(3), "nan": np.array([np.nan, 0]), "future": np.zeros(2), "keys": np.zeros(2)}[what]
        key, at = ("image" if what == "keys" else "obs"), at + (1.0 if what == "future" else 0.0)
        self.use(lambda: self.world.executor.observe({key: obs}, at), ObservationError, always=True)

    @rule(seed=st.none() | st.integers(0, 9), moment=st.floats(0, 0.2))
    def reset(self, seed: int | None, moment: float) -> None:
        self.world.clock.advance(moment)
        if self.use(lambda: self.world.executor.reset(seed)):
            self.world.episode += 1
            self.good, self.held, self.last, self.stood = 0, 0, None, (0.0, 0.0)
        self.world.clock.settle()

    @rule(seed=st.none() | st.integers(0, 9))
    def reset_during_a_call(self, seed: int | None) -> None:
        for _ in range(TA):
            if len(self.policy.calls) > self.counts.calls:
                break
            self.drive(1)
        self.reset(seed, 0.0)
        self.drive(4)

    @rule(fault=st.sampled_from(["raise", "hang", "nan", 0.3, 0.9, 5.0]), after=st.integers(0, 2))
    def break_a_call(self, fault: str | float, after: int) -> None:
        self.policy.fault[len(self.policy.calls) + after] = fault
        self.good = 0
        self.drive((after + 2) * TA)

    @rule()
    def end_what_hangs(self) -> None:
        self.policy.release()
        self.world.clock.settle()
        self.good = 0

    @precondition(lambda self: self.world.time > 10 or self.died())
    @rule(wait=st.floats(0, 0.2))
    def close_and_open_another(self, wait: float) -> None:
        self.world.clock.advance(wait)
        self.teardown()
        self.open(self.seam, round(self.world.hz / HZ), self.policy.reserve)

    # What must be true

    def use(self, call: Callable[[], object], allowed: type[Exception] | tuple[()] = (), always: bool = False) -> bool:
        """Make a call; whether it came back.

        What the policy raised must come out of every call, and nothing else may.
        """
        self.world.clock.settle()
        dead = self.died()
        try:
            call()
        except WorkerDeadError as error:
            assert dead or self.died(), "the worker is dead, and the policy raised nothing"
            assert isinstance(error.__cause__, ZeroDivisionError)  # noqa: PT017
            return False
        except allowed:
            # A frame is checked before anything else, so its own error comes first.
            assert not dead or always, "the policy raised, and the caller was told something else"
            return False
        assert not dead, "what the policy raised was lost"
        assert not always, "a wrong frame was taken"
        return True

    @property
    def healthy(self) -> int:
        return HEALTHY * round(self.world.hz / HZ)

    @property
    def counts(self) -> SimpleNamespace:
        """Without the percentiles of ``statistics()``, which would be half of the time that this takes."""
        return self.world.executor._state.recorder.counts

    def missed(self) -> int:
        return self.counts.deadlines_missed

    def died(self) -> bool:
        return not workers()

    def observe(self, at: float) -> None:
        self.use(lambda: self.world.observe(at))

    def act(self, timeout: float | None) -> None:
        made: list[np.ndarray] = []
        world = self.world
        try_action = self.use(lambda: made.append(world.executor.action(timeout=timeout)), DeadlineMissedError)
        if not try_action:
            assert self.died() or self.good < self.healthy, "starved, although nothing was wrong for long enough"
            return
        (action,) = made
        now, (episode, seen, index) = world.time, action.tolist()
        assert np.isfinite(action).all()
        assert episode == world.episode, "an action from before a reset"
        grid = round(now * world.hz)
        if self.last is not None and np.array_equal(action, self.last[1]):
            self.held = self.held + grid - self.last[0]
        else:
            self.held = 0
        most = MAX_HOLD + round(world.hz / HZ)
        assert self.held <= most, f"held for {self.held} ticks"
        # A mean of chunks is a mean of their times of observation, and still an action for now.
        ahead = seen + index / HZ - now
        if self.last is None:
            assert index < 1, "the first chunk was not begun at its beginning"
            self.stood = now + (TA + self.policy.reserve) / HZ, -min(ahead, 0.0)
        # The first chunk is played as much later as the robot stood still before it.
        stood = self.stood[1] if now <= self.stood[0] + self.held / world.hz else 0.0
        assert -1.2 / HZ - stood <= ahead + self.held / world.hz <= 1.2 / HZ, f"stale by {-ahead} s"
        assert -1e-3 <= index <= TA - 1 + self.policy.reserve + 1e-3
        self.last = (grid, action)

    def step(self) -> None:
        Schedule.ticks += 1
        self.world.clock.advance(1 / self.world.hz)
        if any(number >= self.counts.calls for number in self.policy.fault):
            self.good = 0  # a fault is still to come, or under way

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        world = self.world
        world.clock.free()
        self.policy.release()
        try:
            world.executor.close(timeout=10.0)
        except WorkerDeadError as error:
            assert isinstance(error.__cause__, ZeroDivisionError)  # noqa: PT017
        assert workers() == [], "a thread is left"
        for start, _, obs in self.policy.calls:
            (_, before), (_, newest) = obs[0]
            assert start - world.start - newest <= 3 / HZ + 1e-6, "a call from an observation that was too old"
            assert newest - before == pytest.approx(1 / HZ, abs=0.3 / HZ + 1e-6), (
                "a window of frames not a period apart"
            )
        for use in (world.executor.action, world.executor.reset):
            with pytest.raises((ExecutorClosedError, WorkerDeadError)):
                use()


def run(ticks: int, derandomize: bool) -> int:
    """Run at least so many ticks; how many they were."""
    Schedule.ticks, examples = 0, 10
    while Schedule.ticks < ticks:
        checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
        run_state_machine_as_test(
            Schedule,
            settings=settings(
                max_examples=examples,
                stateful_step_count=50,
                deadline=None,
                suppress_health_check=checks,
                database=None,
                derandomize=derandomize,
            ),
        )
        examples = min(2 * examples, 400)
    return Schedule.ticks


@pytest.mark.slow
def test_random_schedules() -> None:
    assert run(3_000, derandomize=True) >= 3_000


@pytest.mark.slow
@pytest.mark.soak
def test_a_hundred_thousand_ticks() -> None:
    ticks = run(100_000, derandomize=False)
    print(f"{ticks} ticks")
