"""A world under ``AsyncExecutor`` with a latency that is given: nothing waits, and every run is the same.

The world takes one step a tick, whether there is an action or not; a call of the policy takes as long as it is told to,
on a clock of the simulation. The machine's speed has no part in what comes out.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from environments import Array, Environment
from rollout import Episode, Recorder
from variants import Variant, seeded_noise

from ttscompile import AsyncExecutor, ExecutorSettings
from ttscompile.errors import DeadlineMissedError

TINY = 1e-9
"""Seconds; what is meant to happen at one time is not told apart by rounding."""
STUCK = 0.1
"""Seconds of real time after which the simulation looks whether the executor's thread is still alive."""


class LockStepClock:
    """``Clock`` on which one thread runs at a time: the executor's only while the simulation hands over to it."""

    def __init__(self) -> None:
        self._now, self._until = 0.0, float("inf")
        self._go, self._parked = threading.Semaphore(0), threading.Semaphore(0)
        self._worker: threading.Thread | None = None
        self._free = False

    def now(self) -> float:
        """Seconds since the start of the simulation."""
        return self._now

    # The executor's thread

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """See ``Clock.wait``."""
        if self._free:
            condition.wait(timeout)
            return
        self._until = float("inf") if timeout is None else self._now + timeout
        condition.release()
        try:
            self._park()
        finally:
            condition.acquire()

    def take(self, seconds: float) -> None:
        """Return when so much time has passed."""
        end = self._now + seconds
        while not self._free and self._now < end - TINY:
            self._until = end
            self._park()

    def _park(self) -> None:
        self._worker = threading.current_thread()
        self._parked.release()
        self._go.acquire()

    # The simulation's thread

    def join(self) -> None:
        """Return when the executor's thread waits, or has ended: once, when it was started."""
        while not self._parked.acquire(timeout=STUCK):
            if self._worker is not None and not self._worker.is_alive():
                return

    def advance(self, when: float) -> None:
        """Move to a time. What the executor's thread wanted to do before that is done on the way."""
        while self._until < when - TINY:
            self._now = max(self._until, self._now)
            self._hand_over()
        self._now = when

    def settle(self) -> None:
        """Let the executor's thread do what is to be done now."""
        self._hand_over()
        while self._until <= self._now + TINY:
            self._now = max(self._until, self._now)
            self._hand_over()

    def free(self) -> None:
        """Let the executor's thread go; it waits in real time from now on, and calls take none."""
        self._free = True
        self._go.release()

    def _hand_over(self) -> None:
        self._until = float("inf")
        self._go.release()
        self.join()


class DelayedPolicy:
    """A policy whose calls take a given time, with noise that depends on a seed and the number of the call only.

    Attributes:
        windows: by key ``[To, ...]``, the observation of each call since the last reset.
    """

    def __init__(self, variant: Variant, clock: LockStepClock, latency: float) -> None:
        self._variant, self._clock, self._latency = variant, clock, latency
        self.info = variant.policy.info
        self._seed = 0
        self.windows: list[Mapping[str, Array]] = []

    def reset(self, seed: int | None = None) -> None:
        """A new episode; without a seed, as the executor's watchdog asks for it, its noise goes on."""
        self._variant.policy.reset()
        if seed is not None:
            self._seed, self.windows = seed, []

    def follow(self, executed: int) -> None:
        """See ``CompiledPolicy.follow``."""
        getattr(self._variant.policy, "follow", lambda _: None)(executed)

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str, prefix: Any = None) -> Mapping[str, Any]:
        """One call, with the next noise."""
        noise = seeded_noise(self._variant.noise, [self._seed], len(self.windows))
        self.windows.append({key: array[0] for key, array in obs_dict.items()})
        given = {} if prefix is None else {"prefix": prefix}
        predicted: Mapping[str, Any] = self._variant.policy.predict_action(obs_dict, noise=noise, plan=plan, **given)
        self._clock.take(self._latency)
        return predicted


@dataclass(frozen=True)
class Setup:
    """How the policy is driven.

    Attributes:
        latency_ms: of every call; the executor knows it.
        seam: as in ``ExecutorSettings``.
        margin: ticks that a chunk shall be there before it is needed.
        horizon: actions from one call to the next; None for as many as the policy executes.
        hz: ticks a second, each one step of the environment.
        stall_after: as in ``ExecutorSettings``, as is the next.
        displacements: channels whose actions say how far to move.
    """

    latency_ms: float
    seam: str
    margin: int
    horizon: int | None
    hz: float
    stall_after: float | None = None
    displacements: tuple[int, ...] = ()

    @property
    def label(self) -> str:
        """All but the latency."""
        horizon = "" if self.horizon is None else f", horizon {self.horizon}"
        watchdog = "" if self.stall_after is None else f", watchdog {self.stall_after:g} s"
        return f"{self.seam}, margin {self.margin}{horizon}{watchdog}"

    def settings(self, plan: str) -> ExecutorSettings:
        """Of the executor.

        Raises:
            ExecutorError: this is not possible.
        """
        return ExecutorSettings(
            seam=self.seam,
            margin_ticks=self.margin,
            horizon=self.horizon,
            tiers=(plan,),
            stall_after=self.stall_after,
            displacements=self.displacements,
            refuse_infeasible=False,
            trace_events=0,
        )


@dataclass(frozen=True)
class Driven:
    """One episode.

    Attributes:
        episode: what happened.
        still: ticks without any action, in which the robot was told to stay where it is; those before the first chunk
            are among them.
        bridged: ticks with an action in reserve or with the last one held, because a chunk was late.
        age: ticks from the observation that an action was computed from to when it was executed, median; None if there
            never was an action.
        stalls: calls of the watchdog.
    """

    episode: Episode
    still: int
    bridged: int
    age: float | None
    stalls: int = 0


def drive(make: Callable[[], Environment], variant: Variant, setup: Setup, seed: int) -> Driven:
    """Run one episode. The world never waits, not for the first chunk either: the robot stands still until it comes.

    Args:
        make: the world.
        variant: policy and plan.
        setup: how it is driven.
        seed: of the initial state and of the noise.
    """
    plan = variant.plan or variant.policy.info.default_plan
    clock, world = LockStepClock(), Recorder(make(), seed)
    latency = setup.latency_ms / 1e3
    policy = DelayedPolicy(variant, clock, latency)
    settings = setup.settings(plan)
    latencies = dict.fromkeys((plan, settings.stall_plan), latency)
    executor = AsyncExecutor(policy, setup.hz, settings, clock=clock, latencies=latencies)
    still = 0
    try:
        clock.join()
        executor.reset(seed)
        clock.settle()
        while not world.environment.done:
            clock.advance(world.steps / setup.hz)
            executor.observe({key: world.look()[key] for key in policy.info.observation})
            clock.settle()
            try:
                action = executor.action()
            except DeadlineMissedError:
                still += 1
                action = world.environment.rest()
            world.step(action)
        statistics = executor.statistics()
    finally:
        clock.free()
        executor.close(timeout=120)
        world.environment.close()
    age = statistics.action_age_ms
    world.windows = policy.windows
    bridged = statistics.reserve + statistics.holds
    ticks = None if age is None else age.p50 * setup.hz / 1e3
    return Driven(world.episode(), still, bridged, ticks, statistics.stalls)
