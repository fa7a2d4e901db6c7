"""``AsyncExecutor``: the action for *now*, while the next chunk is computed in the background.

Who owns what:

- The *policy*, with its runtime, its caches and its random numbers, belongs to the worker thread, from the constructor
  to the end of ``close``. Nobody else calls it: a reset is a note to the worker.
- The *state* (``state.ExecutorState``) belongs to whoever holds ``_lock``, for microseconds at a time: never during a
  call of the policy, never while frames are copied.
- ``_work`` wakes the worker, ``_news`` those who wait for an action. Both are conditions on ``_lock``; nothing polls.
- The *trace* takes events from any thread.
- What the worker raises ends it, is kept in ``_failure``, and is raised at the next call of anybody.
- A reset counts the *epoch* up. A call carries the epoch that it was started in, and what it computes is thrown away if
  that is over.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import FloatArray
from ttscompile.errors import ExecutorClosedError, ExecutorError, NonFiniteActionsError, WorkerDeadError
from ttscompile.runtimes.arrays import check_seed

from .feasibility import Feasibility, LatencyWindow, fast_enough
from .measure import Clock, MonotonicClock, measure_latencies, require_prefix
from .settings import ExecutorSettings, Policy, resolve
from .state import ExecutorState, Job
from .statistics import ExecutorStatistics, statistics
from .trace import CONTROL, Trace
from .window import FrameSpec


class AsyncExecutor:
    """Runs a policy on a thread of its own, so that a control loop always has the action for now.

    One control loop calls ``observe`` and ``action`` at ``control_hz``; frames may also come from another thread, at
    another rate. The policy must not be used by anybody else until ``close``::

        with ttscompile.AsyncExecutor(policy, control_hz=10) as executor:
            while running:
                executor.observe({"obs": frame})
                if executor.ready:                 # the first chunk is there
                    robot.move(executor.action())  # never waits
                wait_for_the_next_tick()

    Args:
        policy: a ``CompiledPolicy`` on any runtime, or what acts like one.
        control_hz: ticks a second of the control loop.
        settings: everything else.
        clock: what time it is; None for ``time.monotonic``.
        latencies: seconds of the longest call of each tier, if they are known; None has them measured now.
        open_timeout: seconds, of real time, that this may take.

    Raises:
        ExecutorError: the settings do not fit the policy.
        InfeasibleError: no tier is fast enough; the message has the arithmetic.
    """

    def __init__(
        self,
        policy: Policy,
        control_hz: float,
        settings: ExecutorSettings | None = None,
        *,
        clock: Clock | None = None,
        latencies: Mapping[str, float] | None = None,
        open_timeout: float = 120.0,
    ) -> None:
        self._settings = settings = settings or ExecutorSettings()
        info = policy.info
        self._resolved = resolve(settings, info, control_hz)
        if settings.seam == "prefix":
            require_prefix(policy)
        self._policy = policy
        self._normalizer = info.action.normalizer if info.action.ranged else None
        self._given_latencies = latencies
        self._clock = clock or MonotonicClock()
        self._identity = str(getattr(info, "identity", ""))  # anything that predicts may be driven
        self.trace = Trace(settings.trace_events, self._identity)
        self._lock = threading.Lock()
        self._work, self._news = threading.Condition(self._lock), threading.Condition(self._lock)
        self._state: ExecutorState | None = None
        self._failure: BaseException | None = None
        self._failure_told = False
        self._closing = False
        self._waiting = False  # the worker has nothing to do
        self._timed = False  # and looks again by itself
        self._reset_due = True
        self._reset_seed: int | None = None
        self._feasibility: dict[str, Feasibility] = {}
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ttscompile-executor", daemon=True)
        self._thread.start()
        if not self._ready.wait(open_timeout):
            self._closing = True
            what = f"the policy was not measured within {open_timeout:g} s: a call of it hangs, or is very slow."
            raise ExecutorError(f"{what} Look at 'ttscompile realtime DIR'.")
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    # The control loop's side

    def observe(self, obs: Mapping[str, Any], t: float | None = None) -> None:
        """Give one frame. Never blocks.

        Args:
            obs: by key, without the axes of batch and time: ``{"obs": float32 [Do]}``. Copied.
            t: when it was taken, on the executor's clock; None for now. Frames may come late and out of order.

        Raises:
            ObservationError: it does not fit the policy, is not finite, or comes from the future.
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        frame = self._resolved.frames.check(obs)
        with self._lock:
            state = self._checked()
            now = self._clock.now()
            state.observe(frame, now if t is None else t, now)
            if self._waiting and (start := state.next_start(now)) is not None and (start == now or not self._timed):
                self._work.notify()

    def action(self, t: float | None = None, timeout: float | None = None) -> FloatArray:
        """The action for a time.

        Args:
            t: on the executor's clock; None for now. Must not go backwards within an episode.
            timeout: seconds to wait, if none is scheduled, for a chunk that has one. None does not wait. When they are
                over, the last action is held if the settings allow it.

        Returns:
            float32 ``[Da]``, the caller's own.

        Raises:
            DeadlineMissedError: there is none, and the last one was held for as long as it may be.
            StaleObservationError: the same, because no recent observation came.
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        with self._lock:
            state = self._checked()
            start = now = self._clock.now()
            until = now if timeout is None else now + timeout
            reserve = state.recorder.counts.reserve
            while (action := state.play(now if t is None else t, now)) is None and now < until:
                self._clock.wait(self._news, until - now)
                state, now = self._checked(), self._clock.now()
            name = "tick" if state.recorder.counts.reserve == reserve else "reserve"
            if action is None:
                time = now if t is None else t
                name, action = "hold", state.hold(time, now)
                if action is None:
                    name, error = "starved", state.starved(time, now)
        if self.trace.on:
            self.trace.span(CONTROL, name, start, self._clock.now() - start)
        if action is None:
            raise error
        return action

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode. Never blocks; nothing that was computed or observed before is played after it.

        Args:
            seed: of the policy's noise from here on; None goes on with the sequence under way.

        Raises:
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
            TtscompileError: the seed is no whole number of at least 0; the episode goes on.
        """
        seed = check_seed(seed)
        with self._lock:
            state = self._checked()
            state.reset()
            self._reset_due = True
            if seed is not None:
                self._reset_seed = seed
            self._work.notify()
            if self.trace.on:
                self.trace.instant(CONTROL, "reset", self._clock.now(), {"epoch": state.epoch})

    def close(self, timeout: float = 10.0) -> None:
        """End the thread, after the call that it is in. The policy may be used again after this.

        Args:
            timeout: seconds, of real time, to wait for it.

        Raises:
            ExecutorError: a call of the policy did not end in time. Its thread is left behind, and ends with the call
                or the process.
            WorkerDeadError: the thread had ended because of an error that nobody was told.
        """
        with self._lock:
            self._closing = True
            self._work.notify_all()
            self._news.notify_all()
        self._thread.join(timeout)
        if self._thread.is_alive():
            what = f"the policy is still in a call, {timeout:g} s after close(): it hangs, or is slower than that"
            raise ExecutorError(f"{what}. Its thread is left behind; do not use the policy again.")
        if not self._failure_told:
            self._raise_failure()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except ExecutorError as closing:
            if error is None:
                raise
            error.add_note(f"closing the executor failed too: {closing}")

    def statistics(self) -> ExecutorStatistics:
        """What happened so far; works after ``close`` too."""
        with self._lock:
            state = self._opened()
            plan, copied = state.plan, state.recorder.copy()
        return statistics(plan, copied, self._identity)

    def feasibility(self) -> dict[str, Feasibility]:
        """The arithmetic of each tier, as measured when the executor was made."""
        return self._feasibility

    @property
    def ready(self) -> bool:
        """Whether a chunk of this episode has come: from then on, a tick without an action is a fault.

        Raises:
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        with self._lock:
            return self._checked().ready

    @property
    def frames(self) -> FrameSpec:
        """What ``observe`` takes: shapes and dtypes of one frame."""
        return self._resolved.frames

    @property
    def rates(self) -> tuple[float, float]:
        """Control rate and policy rate, Hz."""
        return self._resolved.control_hz, self._resolved.policy_hz

    @property
    def bridged(self) -> int:
        """Actions in reserve, and held ones, given out so far because a chunk was late.

        Cheaper than ``statistics``, for a loop that looks at every tick.
        """
        counts = self._opened().recorder.counts
        return counts.reserve + counts.holds

    def now(self) -> float:
        """Seconds on the executor's clock: what times of observations and actions are compared with."""
        return self._clock.now()

    def _opened(self) -> ExecutorState:
        assert self._state is not None  # the constructor waited for it
        return self._state

    def _checked(self) -> ExecutorState:
        self._raise_failure()
        if self._closing:
            raise ExecutorClosedError("the executor was closed. Make another one.")
        return self._opened()

    def _raise_failure(self) -> None:
        """Raise if the worker has ended by an error."""
        failure = self._failure
        if failure is not None:
            self._failure_told = True
            raised = f"a call raised {type(failure).__name__}: {failure}"
            remedy = "Stop the robot safely; close this executor, and make another one when the cause is gone."
            raise WorkerDeadError(f"the thread that owns the policy has ended, because {raised}. {remedy}") from failure

    # The worker's side

    def _run(self) -> None:
        try:
            self._open()
            while (due := self._next()) is not None:
                if isinstance(due, Job):
                    self._call(due)
                else:
                    self._policy.reset(*due)
        except BaseException as error:
            with self._lock:
                self._failure = error
                if self._state is not None:
                    self._state.fail()
                self._news.notify_all()
        finally:
            self._ready.set()

    def _open(self) -> None:
        """Pin the thread, measure the tiers, refuse what is infeasible."""
        settings, resolved, given = self._settings, self._resolved, self._given_latencies
        if settings.cores is not None:
            _pin(settings.cores)
        if given is None:
            self._policy.reset()
            times = measure_latencies(self._policy, self._clock, settings, resolved.tiers)
            measured = {name: [ms / 1e3 for ms in each.ms] for name, each in times.items()}
        elif missing := [name for name in resolved.tiers if name not in given]:
            raise ExecutorError(f"latencies lacks the tier {missing[0]!r}; give one for each of {resolved.tiers}.")
        else:
            measured = {name: [given[name]] for name in resolved.tiers}
        latencies = {name: LatencyWindow(settings.latency_window, values) for name, values in measured.items()}
        self._feasibility = {name: resolved.feasibility(max(values)) for name, values in measured.items()}
        tiers = fast_enough(self._feasibility, settings.refuse_infeasible)
        with self._lock:
            self._state = ExecutorState(settings, resolved, self._normalizer, tiers, latencies)
        self._ready.set()

    def _next(self) -> Job | tuple[int | None] | None:
        """Wait for what to do: a call, a reset of the policy with a seed, or (None) the end."""
        with self._lock:
            state = self._opened()
            while not self._closing:
                if self._reset_due:
                    seed, self._reset_due, self._reset_seed = self._reset_seed, False, None
                    return (seed,)
                now = self._clock.now()
                start = state.next_start(now)
                if start is not None and start <= now:
                    return state.begin(now)
                self._waiting, self._timed = True, start is not None
                self._clock.wait(self._work, None if start is None else start - now)
                self._waiting = False
        return None

    def _call(self, job: Job) -> None:
        resolved = self._resolved
        obs = resolved.frames.observation(job.frames)
        prefix = {} if job.prefix is None else {"prefix": job.prefix[None]}
        last = resolved.first + resolved.horizon + resolved.reserve
        try:
            predicted = np.asarray(self._policy.predict_action(obs, plan=job.plan, **prefix)["action_pred"])
        except NonFiniteActionsError:  # the guard refuses them, as it does those of a policy that gives them out
            predicted = np.full((1, last, resolved.channels), np.nan, np.float32)
        streams, steps, channels = predicted.shape if predicted.ndim == 3 else (0, 0, 0)
        if streams != 1 or steps < last or channels != resolved.channels:
            expected = f"[1, T, Da] with T of at least {last} and Da = {resolved.channels}"
            raise ExecutorError(f"the policy's action_pred has shape {list(predicted.shape)}; expected {expected}.")
        actions: npt.NDArray[np.float32] = predicted[0, resolved.first : last].astype(np.float32)
        with self._lock:
            now = self._clock.now()
            outcome = self._opened().finish(job, actions, now)
            self._news.notify_all()
        if self.trace.on:
            args = {"plan": job.plan, "epoch": job.epoch, "chunk": outcome}
            report = getattr(self._policy, "last_report", None)
            self.trace.call(job.started, now, args, None if report is None else report.timings)


def _pin(cores: tuple[int, ...]) -> None:
    """Keep the calling thread on these processors."""
    if not hasattr(os, "sched_setaffinity"):
        raise ExecutorError("cores cannot be set on this system. Leave ExecutorSettings.cores at None.")
    try:
        os.sched_setaffinity(0, cores)
    except OSError as error:
        usable = sorted(os.sched_getaffinity(os.getpid()))
        problem = f"the policy's thread cannot be pinned to {cores}: {error}"
        raise ExecutorError(f"{problem}. This process may use {usable}.") from error
