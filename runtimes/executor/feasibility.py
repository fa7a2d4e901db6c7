"""Whether a policy keeps up with a control loop, and which of its plans does. No clock, no threads.

A call starts when a frame comes. The next one starts when the policy would have executed a chunk, ``play`` later, or as
much sooner as it must to be done ``margin`` before the actions of the first run out::

    frame: call n                  frame: call n + 1                   what n predicted runs out
       |=====latency=======|.........|=====latency=======|----margin---->|
       |<----------- play ---------->|                                   |
       |<--------------------------- predicted ------------------------->|

It can start when the first is done. If it has to start before the policy would have executed a chunk, it starts with
the last frame that comes early enough, which may be a frame period sooner than it has to. So the calls follow each
other without a gap in the actions if ``frame period + 2 * latency + margin <= predicted`` and ``latency <= play``.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from statistics import median
from typing import Any

from ttscompile.errors import InfeasibleError

MOST_PATIENCE = 32
"""Times ``up_after`` that a tier which failed again and again has to wait at most."""


def _ms(seconds: float) -> str:
    """In milliseconds, to four digits at least, without an exponent."""
    return f"{1e3 * seconds:.4g}" if seconds < 10 else f"{1e3 * seconds:.0f}"


@dataclass(frozen=True)
class Feasibility:
    """The arithmetic of one policy on one loop. Times in seconds.

    Attributes:
        latency: the longest call that has to be reckoned with.
        policy_hz: rate of observations and actions in the policy's own time.
        horizon_steps: actions of a chunk that the policy executes: ``play``.
        margin_ticks: control ticks that a chunk shall be there before it is needed.
        reserve_steps: actions after these that may be played.
        prefix_steps: actions that may be committed while a call computes; 0 for any number.
    """

    latency: float
    control_hz: float
    policy_hz: float
    horizon_steps: int
    margin_ticks: int
    reserve_steps: int = 0
    prefix_steps: int = 0

    @property
    def frame_period(self) -> float:
        """Seconds from one frame to the next, and so for which a call may have to wait for one."""
        return 1 / self.policy_hz

    @property
    def margin(self) -> float:
        """``margin_ticks`` in seconds."""
        return self.margin_ticks / self.control_hz

    @property
    def play(self) -> float:
        """How long the policy executes a chunk."""
        return self.horizon_steps / self.policy_hz

    @property
    def predicted(self) -> float:
        """How long the actions of a chunk last, from its observation on, if all that may be played are."""
        return (self.horizon_steps + self.reserve_steps) / self.policy_hz

    @property
    def committed(self) -> float:
        """How long a call may take for no more than ``prefix_steps`` to be committed, the first at its beginning."""
        return self.prefix_steps / self.policy_hz - 1 / self.control_hz if self.prefix_steps else inf

    @property
    def needed(self) -> float:
        """How long the actions of a chunk have to last for calls to follow each other without a gap."""
        return self.frame_period + 2 * self.latency + self.margin

    @property
    def max_latency(self) -> float:
        """The longest call with which this would be feasible; not positive if none would be."""
        return min(self.play, self.committed, (self.predicted - self.frame_period - self.margin) / 2)

    @property
    def max_policy_hz(self) -> float:
        """The fastest rate of this latency, with as many control ticks an action as now; 0 if there is none."""
        ticks_per_step = self.control_hz / self.policy_hz
        covered = (self.horizon_steps + self.reserve_steps - 1 - self.margin_ticks / ticks_per_step) / 2
        return max(min(self.horizon_steps, covered), 0.0) / self.latency

    @property
    def feasible(self) -> bool:
        """Whether the calls keep up."""
        return self.needed <= self.predicted + 1e-12 and self.latency <= min(self.play, self.committed + 1e-12)

    def explain(self) -> str:
        """The arithmetic on one line, in milliseconds."""
        covered = self.needed <= self.predicted + 1e-12
        if covered and self.latency <= self.play and not self.feasible:
            lasts = f"{_ms(self.committed)} ms, of a prefix of {self.prefix_steps} actions at {self.policy_hz:g} Hz"
            return f"latency {_ms(self.latency)} ms > {lasts}, the longest that the policy was trained with"
        if covered and not self.feasible:
            lasts = f"{_ms(self.play)} ms = {self.horizon_steps} actions"
            return f"latency {_ms(self.latency)} ms > {lasts} at {self.policy_hz:g} Hz, to the next call"
        return (
            f"frame period {_ms(self.frame_period)} + 2 x latency {_ms(self.latency)} + margin {_ms(self.margin)}"
            f" = {_ms(self.needed)} ms {'<=' if covered else '>'} {_ms(self.predicted)} ms"
            f" = {self.horizon_steps + self.reserve_steps} actions at {self.policy_hz:g} Hz"
        )

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        derived = ("needed", "play", "predicted", "max_latency", "max_policy_hz", "feasible")
        return asdict(self) | {name: getattr(self, name) for name in derived}


def fast_enough(judged: Mapping[str, Feasibility], refuse: bool) -> tuple[str, ...]:
    """The plans that keep up, of those judged by name, slowest first. If none does, the last is taken all the same.

    Raises:
        InfeasibleError: none keeps up, and this is to be refused; has the arithmetic of each.
    """
    possible = tuple(name for name, each in judged.items() if each.feasible)
    if possible or not refuse:
        return possible or tuple(judged)[-1:]
    sums = "; ".join(f"plan {name!r}: {each.explain()}" for name, each in judged.items())
    longest = next(iter(judged.values())).max_latency
    remedy = "a lower rate, or more of each chunk (ExecutorSettings.horizon and reserve)"
    plan = f"a plan whose calls take at most {1e3 * longest:.4g} ms"
    raise InfeasibleError(f"no plan is fast enough for this loop. {sums}. Use {plan}, {remedy}.")


class LatencyWindow:
    """What calls take, by the last ones. Warm-up calls are made, and left out, before there is one of these.

    Attributes:
        bound: the longest of them, in seconds.
    """

    def __init__(self, window: int, latencies: Iterable[float] = ()) -> None:
        self._latencies: deque[float] = deque(maxlen=window)
        self.bound = self._typical = 0.0
        for latency in latencies:
            self.add(latency)

    def add(self, latency: float) -> None:
        """Take the latency of a call, in seconds."""
        self._latencies.append(latency)
        self.bound, self._typical = max(self._latencies), median(self._latencies)

    def reckoned(self, most: float) -> float:
        """What the next call is reckoned to take, in seconds: as long as the longest that a schedule can cover.

        An exception beyond that, because the host stood still, is no reason to give up the distance between calls until
        it is forgotten. Where most calls are beyond it, the longest counts.
        """
        if self.bound <= most or self._typical > most:
            return self.bound
        return max(each for each in self._latencies if each <= most)


class Tiers:
    """Which plan the next call runs.

    A tier is left downwards after ``down_after`` missed deadlines in a row, and upwards after ``up_after`` calls in
    time. A tier that fails soon after it was tried again has to wait twice as long before the next try, so that a load
    which stays does not cost a missed deadline every ``up_after`` calls.

    Args:
        plans: names, slowest first.
        down_after: missed deadlines in a row that lead to the next faster plan.
        up_after: calls in time, in a row, that lead back.
    """

    def __init__(self, plans: Sequence[str], down_after: int, up_after: int) -> None:
        self.plans = tuple(plans)
        self._down_after, self._up_after = down_after, up_after
        self._current = 0
        self._missed, self._in_time = 0, 0
        self._patience = 1
        self._climbed = False

    @property
    def plan(self) -> str:
        """Name of the plan that the next call runs."""
        return self.plans[self._current]

    def after_call(self, missed: bool) -> int:
        """Take note of a call: 1 if this leads to a faster plan, -1 if back to a slower one, else 0."""
        if missed:
            self._missed, self._in_time = self._missed + 1, 0
            if self._missed < self._down_after or self._current == len(self.plans) - 1:
                return 0
            if self._climbed:
                self._patience = min(2 * self._patience, MOST_PATIENCE)
            self._move(1)
            self._climbed = False
            return 1
        self._missed, self._in_time = 0, self._in_time + 1
        if self._climbed and self._in_time >= self._up_after:
            self._climbed, self._patience = False, 1  # it holds: forget that it once failed
        if self._current == 0 or self._in_time < self._up_after * self._patience:
            return 0
        self._move(-1)
        self._climbed = True
        return -1

    def _move(self, by: int) -> None:
        self._current += by
        self._missed, self._in_time = 0, 0
