"""A world without real time: a clock that tests advance, and a policy whose latency, faults and actions are scripted.

The worker thread is real. Advancing the clock wakes it where it waits, and returns when it waits again, so that every
run is the same.
"""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from ttscompile import Affine, ChunkSpec, ObservationSpec
from ttscompile.errors import DeadlineMissedError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings

REAL_LIMIT = 20.0
"""Seconds of real time after which a thread that should have moved is called stuck."""
TO, TA = 2, 8
NORMALIZER = Affine(np.array([0.5, -0.1]), np.array([0.0, 1.0]))
"""Of two numbers, which are in -2..2 and 0..20."""

AS_IT_IS = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""With the two numbers before them they are a pose: a position, and two rows of a rotation that turns nothing."""


def rows(*values: tuple[float, float]) -> np.ndarray:
    return np.array(values, np.float32)


class FakeClock:
    """``Clock`` that stands still until it is advanced. The thread that makes it is the one that may advance it.

    When that thread waits itself, time jumps to the next moment at which anybody wanted to be woken.
    """

    def __init__(self) -> None:
        self._now = 1000.0
        self._owner = threading.current_thread()
        self._waiting: dict[threading.Thread, tuple[threading.Condition, float]] = {}
        self._free = False

    def now(self) -> float:
        return self._now

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        until = float("inf") if timeout is None else self._now + timeout
        thread = threading.current_thread()
        if thread is self._owner:
            condition.release()
            try:
                ends = [each for _, each in list(self._waiting.values())]
                self.advance_to(max(min([until, *ends]), self._now))
            finally:
                condition.acquire()
            return
        if until <= self._now:
            return
        if self._free:
            if timeout is None:
                condition.wait(REAL_LIMIT)
            else:
                self._now = until
            return
        self._waiting[thread] = (condition, until)
        woken = condition.wait(REAL_LIMIT + 10)
        del self._waiting[thread]
        assert woken, "nobody woke a waiting thread"

    def free(self) -> None:
        """From now on nobody waits for a time: it is that time at once."""
        self._free = True
        for condition, until in list(self._waiting.values()):
            self._now = max(self._now, until) if until < float("inf") else self._now
            with condition:
                condition.notify_all()

    def advance(self, seconds: float) -> None:
        self.advance_to(self._now + seconds)

    def advance_to(self, when: float) -> None:
        """Move to a time, stopping wherever a thread wants to be woken on the way."""
        assert when >= self._now
        self.settle()
        while True:
            due = min((until for _, until in list(self._waiting.values())), default=float("inf"))
            self._now = max(self._now, min(when, due))
            for condition, until in list(self._waiting.values()):
                if until <= self._now:
                    with condition:
                        condition.notify_all()
            self.settle()
            if due > when:
                return

    def settle(self) -> None:
        """Return when every thread of an executor waits for something that has not happened."""
        limit = time.monotonic() + REAL_LIMIT
        while not all(self._parked(thread) for thread in workers()):
            assert time.monotonic() < limit, f"stuck: {workers()}"
            time.sleep(0)

    def _parked(self, thread: threading.Thread) -> bool:
        entry = self._waiting.get(thread)
        if entry is None:
            return not thread.is_alive()
        condition, until = entry
        with condition:  # a thread that was notified has left the condition's list, though it may not have run yet
            return until > self._now and len(condition._waiters) > 0  # type: ignore[attr-defined]


def workers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "ttscompile-executor"]


@dataclass(frozen=True)
class Facts:
    """What an executor reads of the ``PolicyInfo`` of a policy that observes ``[episode, seconds]``."""

    observation: Mapping[str, ObservationSpec]
    action: ChunkSpec
    sample: tuple[int, int]
    plans: tuple[str, ...]
    default_plan: str
    trained_prefix: int = 0
    policy_hz: float | None = None


@dataclass
class ScriptedPolicy:
    """Its actions say where they come from: ``[episode, time of the newest frame, index in the chunk]``.

    Attributes:
        clock: that its calls take time of.
        latency: seconds of each plan's calls; the slowest first.
        fault: by number of the call: ``raise``, ``hang``, ``nan``, ``shape`` or seconds that it takes instead.
        calls: what it was called with.
        reserve: actions that it predicts beyond the TA that are executed.
        also: what every frame has after the two numbers.
    """

    clock: FakeClock
    latency: dict[str, float] = field(default_factory=lambda: {"dense": 0.1})
    fault: dict[int, str | float] = field(default_factory=dict)
    actions: Callable[[np.ndarray], np.ndarray] | None = None
    calls: list[tuple[float, str, np.ndarray]] = field(default_factory=list)
    resets: list[int | None] = field(default_factory=list)
    reserve: int = 0
    also: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        spec, chunk = ObservationSpec((TO, 2 + len(self.also)), dtype="float64"), ChunkSpec(3, TO - 1, TO - 1 + TA)
        self.predicted = TO - 1 + TA + self.reserve
        plans = tuple(self.latency)
        self.info: Any = Facts({"obs": spec}, chunk, (self.predicted, 3), plans, plans[0])  # for ``PolicyInfo``
        self._released = threading.Condition()
        self._hanging = False

    def reset(self, seed: int | None = None) -> None:
        self.resets.append(seed)

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        obs = obs_dict["obs"]
        number = len(self.calls)
        self.calls.append((self.clock.now(), plan, obs))
        fault = self.fault.get(number)
        self._take(fault if isinstance(fault, float) else self.latency[plan], fault == "hang")
        if fault == "raise":
            raise ZeroDivisionError("scripted")
        episode, seen = obs[0, -1, :2]
        count = self.predicted
        chunk = np.stack([np.full(count, episode), np.full(count, seen), np.arange(count) - (TO - 1)], axis=1)
        if self.actions is not None:
            chunk = self.actions(obs[0])
        if fault == "nan":
            chunk[3, 1] = np.nan
        if fault == "shape":
            chunk = chunk[:4]
        return {"action": chunk[None, TO - 1 : TO - 1 + TA], "action_pred": chunk[None]}

    def release(self) -> None:
        """Let a hanging call end."""
        with self._released:
            self._hanging = False
            self._released.notify_all()

    def _take(self, seconds: float, hang: bool) -> None:
        until = self.clock.now() + seconds
        with self._released:
            self._hanging = hang
            while self._hanging or self.clock.now() < until:
                self.clock.wait(self._released, None if self._hanging else until - self.clock.now())


@dataclass
class Told(ScriptedPolicy):
    """Attributes: prefixes: what each call was told to be committed, float32 ``[N, 3]``."""

    prefixes: list[np.ndarray] = field(default_factory=list)

    def predict_action(
        self, obs_dict: Mapping[str, Any], *, plan: str, prefix: np.ndarray | None = None
    ) -> dict[str, Any]:
        if prefix is not None:
            self.prefixes.append(prefix[0])
        return super().predict_action(obs_dict, plan=plan)


@dataclass
class Following(ScriptedPolicy):
    """It may begin with its last chunk. Attributes: followed: by number of the call to come, what it was told of it."""

    followed: dict[int, int] = field(default_factory=dict)

    def follow(self, executed: int) -> None:
        self.followed[len(self.calls)] = executed


class Quick(ScriptedPolicy):
    """It takes no time, not even its clock's, and nothing moves."""

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        return {"action_pred": np.zeros((1, 16, 3), np.float32)}


Own = TypeVar("Own", bound="World")


class World:
    """An executor over a scripted policy; times are offsets from the start, so that float32 actions hold them."""

    def __init__(
        self,
        hz: float = 10.0,
        settings: ExecutorSettings | None = None,
        policy: ScriptedPolicy | None = None,
        latency: dict[str, float] | None = None,
        fault: dict[int, str | float] | None = None,
    ) -> None:
        self.clock = policy.clock if policy is not None else FakeClock()
        self.start = self.clock.now()
        self.policy = policy or ScriptedPolicy(self.clock, latency or {"dense": 0.1}, fault or {})
        self.hz, self.episode = hz, 0
        self.ticks_per_step = round(hz / (settings.policy_hz or hz)) if settings else 1
        self.executor = AsyncExecutor(
            self.policy, hz, settings, clock=self.clock, latencies=self.policy.latency, open_timeout=REAL_LIMIT
        )
        self.clock.settle()

    @property
    def time(self) -> float:
        return self.clock.now() - self.start

    def frame(self, at: float | None = None) -> dict[str, np.ndarray]:
        return {"obs": np.array([self.episode, self.time if at is None else at, *self.policy.also])}

    def observe(self, at: float | None = None) -> None:
        """A frame of now, or of an earlier time."""
        at = self.time if at is None else at
        self.executor.observe(self.frame(at), self.start + at)
        self.clock.settle()

    def tick(self, observe: bool = True, action: bool = True) -> np.ndarray:
        """One tick of the control loop: observe, act, wait for the next; an action that is not wanted is empty."""
        if observe:
            self.observe()
        made = self.executor.action() if action else np.zeros(0)
        self.clock.advance(1 / self.hz)
        return made

    def begin(self) -> None:
        """Observe until the first chunk is there."""
        for _ in range((TO - 1) * self.ticks_per_step):
            self.tick(action=False)
        self.observe()
        self.executor.action(timeout=10.0)
        self.clock.advance(1 / self.hz)

    def run(self, ticks: int) -> np.ndarray:
        """Begin, and then so many ticks; their actions ``[ticks, Da]``."""
        self.begin()
        return np.stack([self.tick() for _ in range(ticks)])

    def run_until_starved(self, ticks: int = 100) -> tuple[list[np.ndarray], DeadlineMissedError]:
        """Begin, and tick until there is no action; the actions before that, and the error."""
        made: list[np.ndarray] = []
        self.begin()
        for _ in range(ticks):
            self.observe()
            try:
                made.append(self.executor.action())
            except DeadlineMissedError as error:
                return made, error
            self.clock.advance(1 / self.hz)
        raise AssertionError("never starved")

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(self, *_: object) -> None:
        self.clock.free()
        self.policy.release()
        self.executor.close(timeout=REAL_LIMIT)
        assert workers() == []


def given_out(
    settings: ExecutorSettings, action: ChunkSpec, reserve: int, actions: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Thirty actions of a policy of these chunks, whose loop has two ticks a step where it interpolates."""
    also = () if action.relative is None else AS_IT_IS
    policy = ScriptedPolicy(FakeClock(), actions=actions, reserve=reserve, also=also)
    policy.info = replace(policy.info, action=action, sample=(policy.predicted, action.action_dim))
    with World(20.0 if settings.interpolation == "linear" else 10.0, settings, policy) as world:
        return world.run(30)


def opened_meanwhile(policy: ScriptedPolicy, settings: ExecutorSettings | None = None) -> AsyncExecutor:
    """An executor that measures its policy. Its maker waits for that in real time: another thread, as time goes on."""
    made: list[AsyncExecutor] = []
    opener = threading.Thread(target=lambda: made.append(AsyncExecutor(policy, 10, settings, clock=policy.clock)))
    opener.start()
    while opener.is_alive():
        policy.clock.advance(0.05)
    opener.join()
    return made[0]


def actions_of(
    policy: Any, settings: ExecutorSettings, hz: float, latency: float, seen: Callable[[int], Any], count: int
) -> np.ndarray:
    """So many actions of a loop at the policy's rate, whose calls are said to take so long.

    Args:
        seen: the observation ``obs`` at each tick.
    """
    clock, actions, tick = FakeClock(), list[np.ndarray](), 0
    executor = AsyncExecutor(policy, hz, settings, clock=clock, latencies={"dense": latency})
    clock.settle()
    try:
        while len(actions) < count:
            executor.observe({"obs": np.asarray(seen(tick), np.float32)})
            clock.settle()
            if executor.ready:
                actions.append(executor.action())
            clock.advance(1 / hz)
            tick += 1
    finally:
        clock.free()
        executor.close()
    return np.array(actions)
