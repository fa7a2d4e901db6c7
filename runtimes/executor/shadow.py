"""Shadow mode: the original policy acts, and a compiled one answers the same observations beside it, for nobody.

The *original* belongs to whoever calls the shadow; the *compiled policy* to the shadow's thread, which takes calls in
their order. What was found is under one lock, held for microseconds.
"""

import atexit
import copy
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial, partialmethod
from typing import Any

import numpy as np

from ttscompile.errors import ObservationError
from ttscompile.measure.points import Numbers
from ttscompile.runtimes.helper import Helper

from .measure import Clock, MonotonicClock
from .settings import require_number
from .statistics import Samples, Summary, summary

WAITING, TIMES = 64, 4096
"""Calls that may wait for the compiled policy: more are dropped. And times that percentiles are made from."""


@dataclass(frozen=True, kw_only=True)
class ShadowReport:
    """How far a compiled policy was from the original that acted; differences are in the units of the actions.

    Attributes:
        calls: of the original.
        compared: of these, answered by the compiled policy, too.
        dropped: of these, not given to it: too many waited, or it had missed a frame of the episode.
        failed: of these, in which something of it raised an error.
        late: of the compared ones, that took it longer than the deadline.
        last_failure: the last error; empty if there was none.
        mean: mean absolute difference by number of the action; empty where nothing was compared.
        worst: the largest mean difference of a call, and the call's number, counted from 0; -1 without one.
        of_other_noise: the mean of these in units of ``PolicyInfo.other_noise``: about 1 where noise is not the same.
        original_ms: what calls of the original took.
        compiled_ms: what compared calls of the compiled policy took.
    """

    calls: int
    compared: int
    dropped: int
    failed: int
    late: int
    last_failure: str
    mean: tuple[float, ...]
    worst: tuple[float, int]
    of_other_noise: float | None
    original_ms: Summary | None
    compiled_ms: Summary | None


class Shadow:
    """A policy that answers as ``original`` does, while ``compiled`` answers the same observations for a report.

    Its ``predict_action``, ``predict_action_chunk`` and ``select_action`` take what the original's take, in an
    ``AsyncExecutor`` or in a loop of LeRobot::

        shadow = ttscompile.Shadow(original, ttscompile.load("compiled/"))
        with ttscompile.AsyncExecutor(shadow, control_hz=10) as executor:
            ...
        print(shadow.close())

    The compiled policy is called after the original has answered, on a thread of its own: the caller waits for a copy
    of the observation alone. Whatever happens there, the original's answer is given; errors are counted. After one,
    methods that keep frames from call to call are compared again from the next episode on.

    Args:
        original: takes observations in the robot's units and gives actions in them, as the compiled policy does.
        compiled: a ``CompiledPolicy``, which nobody else may use until ``close``.
        deadline: seconds that a call of it may take; None for as long as the original took.
        noise: given an observation before the original is called, gives the noise that the original will draw, for the
            compiled policy; None for noise of its own.
        clock: None for ``time.monotonic``.

    Attributes:
        worst_observation: of the worst call, for ``np.savez`` and ``ttscompile predict``; None before there is one.

    Raises:
        ExecutorError: the deadline is no such number.
    """

    def __init__(
        self,
        original: Any,
        compiled: Any,
        *,
        deadline: float | None = None,
        noise: Callable[[Mapping[str, Any]], Any] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._deadline = None if deadline is None else require_number(deadline, "deadline")
        self._original, self._compiled, self._noise = original, compiled, noise
        self._other_noise = getattr(getattr(compiled, "info", None), "other_noise", None)
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()
        self._waiting, self._missed = 0, False
        self._episode, self._failed = 0, -1  # number of resets, and the last episode in which something failed
        self._count: Counter[str] = Counter()
        self._failure, self._worst = "", (0.0, -1)
        self._sum = np.zeros(0)  # of the mean differences, by number of the action
        self._times = Samples(TIMES), Samples(TIMES)
        self.worst_observation: Mapping[str, Any] | None = None
        self._helper = Helper("ttscompile-shadow")
        atexit.register(self.close)  # a thread that comes back when the interpreter is gone may abort the process

    @property
    def info(self) -> Any:
        """That of the original; where it has none, that of the compiled policy with one plan, ``original``."""
        own = getattr(self._original, "info", None)
        return own or replace(self._compiled.info, plans=("original",), default_plan="original", frames=0)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._original, name)  # ``last_report`` and ``prepare_frame``, if it has them

    def reset(self, seed: int | None = None) -> None:
        """A new episode of both."""
        given = () if seed is None else (seed,)
        self._original.reset(*given)
        self._episode, self._missed = self._episode + 1, False
        self._give(partial(self._compiled.reset, *given))

    def follow(self, executed: int) -> None:
        """Tells both how many steps of the last chunk are executed before the next call."""
        for policy, tell in ((self._original, lambda note: note()), (self._compiled, self._give)):
            tell(partial(getattr(policy, "follow", lambda _: None), executed))

    def report(self) -> ShadowReport:
        """What was found so far."""
        with self._lock:
            mean, noise = self._sum / max(self._count["compared"], 1), self._other_noise
            return ShadowReport(
                **{name: self._count[name] for name in ("calls", "compared", "dropped", "failed", "late")},
                last_failure=self._failure,
                mean=tuple(mean.tolist()),
                worst=self._worst,
                of_other_noise=float(mean.mean()) / noise if noise and mean.size else None,
                original_ms=summary(*self._times[0].copy()),
                compiled_ms=summary(*self._times[1].copy()),
            )

    def close(self, timeout: float = 10.0) -> ShadowReport:
        """Wait for the calls that are due, for so many seconds of real time, and end the thread."""
        self._helper.end(timeout)
        atexit.unregister(self.close)
        return self.report()

    def _both(self, name: str, obs: Mapping[str, Any], /, plan: Any = None, **words: Any) -> Any:
        """What the original answers; ``plan`` is one of the original's, if it has any."""
        own = {} if plan is None or not hasattr(self._original, "info") else {"plan": plan}
        given = dict(words)
        try:
            given |= {} if self._noise is None else {"noise": self._noise(obs)}
        except Exception as error:
            self._fail(error)
        begun = self._clock.now()
        answer = getattr(self._original, name)(obs, **words, **own)
        took = self._clock.now() - begun
        with self._lock:
            number = self._count["calls"]
            self._count["calls"] += 1
            self._times[0].add(1e3 * took)
            full = self._waiting >= WAITING
            self._missed |= full
            keeps = name != "predict_action"  # frames from call to call
            drop = full or (keeps and (self._missed or self._failed == self._episode))
            self._count["dropped"] += drop
        try:
            if not drop:
                kept = {key: copy.deepcopy(value) for key, value in obs.items()}
                call = partial(getattr(self._compiled, name), kept, **copy.deepcopy(given))
                self._give(partial(self._compare, call, kept, number, _array(answer), self._deadline or took), keeps)
        except Exception as error:
            self._missed = True
            self._fail(error)
        return answer

    predict_action = partialmethod(_both, "predict_action")
    predict_action_chunk = partialmethod(_both, "predict_action_chunk")
    select_action = partialmethod(_both, "select_action")

    def _give(self, work: Callable[[], object], keeps: bool = False) -> None:
        with self._lock:
            self._waiting += 1
        self._helper.submit(partial(self._try, work, self._episode, keeps))

    def _fail(self, error: Exception) -> None:
        with self._lock:
            self._count["failed"] += 1
            self._failure = f"{type(error).__name__}: {error!s:.300}"

    def _try(self, work: Callable[[], object], episode: int, keeps: bool) -> None:
        drop = keeps and self._failed == episode  # it waited behind a call that failed
        try:
            if not drop:
                work()
        except Exception as error:
            self._failed = episode
            self._fail(error)
        with self._lock:
            self._waiting -= 1
            self._count["dropped"] += drop

    def _compare(self, call: Callable[[], Any], obs: Any, number: int, answer: Numbers, within: float) -> None:
        begun = self._clock.now()
        made = _array(call())
        took = self._clock.now() - begun
        steps = min(made.shape[-2], answer.shape[-2])  # a chunk of LeRobot's is longer than what is executed of it
        apart = np.abs(made[..., :steps, :] - answer[..., :steps, :]).reshape(-1, made.shape[-1])
        if not np.isfinite(apart).all():
            raise ObservationError("actions of the original, or of the compiled policy, are not finite.")
        with self._lock:
            self._sum = apart.mean(0) + (self._sum if self._count["compared"] else 0.0)
            self._count["compared"] += 1
            self._count["late"] += took > within
            self._times[1].add(1e3 * took)
            if apart.mean() > self._worst[0] or self._worst[1] < 0:
                self._worst, self.worst_observation = (float(apart.mean()), number), obs


def _array(answer: Any) -> Numbers:
    """The actions of an answer, ``[B, Da]`` or ``[B, Ta, Da]``, whoever's arrays they are."""
    actions = answer["action"] if isinstance(answer, Mapping) else answer
    return np.array(actions.detach().cpu() if hasattr(actions, "detach") else actions, np.float64)
