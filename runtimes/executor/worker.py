"""The executor's thread, and what it shares with those who observe and act.

It knows nothing of the ``AsyncExecutor`` around it, so that an executor which nobody holds any more is collected, and
ends it.
"""

import atexit
import os
import threading
from collections.abc import Callable, Mapping
from functools import partial
from math import inf, nextafter
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ttscompile.errors import ExecutorError, NonFiniteActionsError
from ttscompile.measure.process import LONGEST_WAIT, Process

from .feasibility import Feasibility, LatencyWindow, fast_enough
from .measure import Clock, measure_latencies
from .settings import Policy, Resolved, SeeingPolicy, require_number
from .state import ExecutorState, Job
from .statistics import Trace, tokens_of
from .window import Frame


class Worker:
    """Owns a policy, and calls it when it is time.

    Attributes:
        lock: of everything here that several threads use; held for microseconds.
        news: notified when a call has ended; a condition on ``lock``.
        failure: what ended the thread; None if nothing did.
    """

    def __init__(self, policy: Policy, settings: Resolved, clock: Clock, trace: Trace) -> None:
        self._policy, self._settings = policy, settings
        self._clock, self._trace = clock, trace
        prepares = bool(getattr(policy.info, "frames", 0)) and settings.frames.seen_before
        self._seeing = cast("SeeingPolicy", policy) if prepares else None
        self.lock = threading.RLock()  # the handler of a signal may come in while it is held, and close
        self._work, self.news = threading.Condition(self.lock), threading.Condition(self.lock)
        self.process = Process()
        self._state: ExecutorState | None = None
        self.feasibility: dict[str, Feasibility] = {}
        self.failure: BaseException | None = None
        self._ending = self._ended = False
        self._waiting = False  # there is nothing to do
        self._timed = False  # and the thread looks again by itself
        self._reset_due = True
        self._reset_seed: int | None = None
        self._ready = threading.Event()
        self._latencies: Mapping[str, float] | None = None  # as they were given
        self._thread = threading.Thread(target=self._run, name="ttscompile-executor", daemon=True)

    # Everybody else's side

    def open(self, latencies: Mapping[str, float] | None, timeout: float) -> ExecutorState:
        """Start the thread, and wait until it has measured the policy.

        Args:
            latencies: seconds of the longest call of each of ``Resolved.plans``, if they are known; None has them
                measured.

        Raises:
            ExecutorError: it takes longer than that, or something does not fit.
            InfeasibleError: no tier is fast enough.
        """
        self._latencies = latencies
        atexit.register(self._end_at_exit)
        try:
            self._thread.start()
            opened = self._ready.wait(timeout)
        except BaseException:  # an interrupt: nobody will have an executor to close
            self.end()
            raise
        if not opened:
            self.end()
            what = f"the policy was not measured within {timeout:g} s: a call of it hangs, or is very slow."
            raise ExecutorError(f"{what} Look at 'ttscompile bench DIR --control-hz HZ'.")
        if self.failure is not None:
            self._thread.join()
            raise self.failure
        return self._opened_state

    def look_again(self, now: float) -> None:
        """Have the thread see a new observation, if that starts a call sooner than it looks by itself.

        The caller holds the lock.
        """
        if self._waiting and self._state is not None:
            start = self._state.next_start(now)
            sooner = start is not None and (start == now or not self._timed)
            if sooner or (self._seeing and self._state.frame_to_prepare(now) is not None):
                self._work.notify()

    def reset(self, seed: int | None) -> None:
        """Have the policy reset before its next call; a seed of None changes nothing. The caller holds the lock."""
        self._reset_due = True
        if seed is not None:
            self._reset_seed = seed
        self._work.notify()

    def end(self) -> None:
        """Have the thread end, after the call that it is in, and wake whoever waits for an action."""
        with self.lock:
            self._ending = True
            self._work.notify_all()
            self.news.notify_all()

    def join(self, timeout: float) -> bool:
        """Whether the thread has ended, some seconds from now at most. The thread itself does not wait for its end."""
        if threading.current_thread() is self._thread:
            return True
        with self.news:  # which lets go of the lock where the handler of a signal came in while it was held
            self.news.wait_for(lambda: self._ended, timeout)
        self._thread.join(timeout if self._ended else 0)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """``end`` for the garbage collector, which may run on any thread, even on this one while it holds the lock."""
        if self._thread.is_alive():
            threading.Thread(target=self.end, name="ttscompile-abandoned", daemon=True).start()

    def _end_at_exit(self) -> None:
        """Wait for the call under way: a thread that comes back when the interpreter is gone may abort the process."""
        if not self.process.left and self._thread.is_alive():
            self.end()
            self.join(LONGEST_WAIT)

    # The thread's side

    def _run(self) -> None:
        try:
            self._open()
            while (due := self._next()) is not None:
                due()
        except BaseException as error:
            with self.lock:
                self.failure = error
                if self._state is not None:
                    self._state.fail()
        finally:
            with self.lock:
                self._ended = True
                self.news.notify_all()
            atexit.unregister(self._end_at_exit)
            self._ready.set()

    def _open(self) -> None:
        settings, given = self._settings, self._latencies
        if settings.cores is not None:
            _pin(settings.cores)
        if given is None:
            self._policy.reset()
            times = measure_latencies(self._policy, self._clock, settings)
            measured = {name: [ms / 1e3 for ms in each.ms] for name, each in times.items()}
        elif missing := [name for name in settings.plans if name not in given]:
            raise ExecutorError(f"latencies lacks the plan {missing[0]!r}; give one for each of {settings.plans}.")
        else:
            allowed = inf, "of seconds", nextafter(0.0, -1.0)  # a latency of 0 is one
            measured = {
                name: [require_number(given[name], f"the latency of plan {name!r}", *allowed)]
                for name in settings.plans
            }
        latencies = {name: LatencyWindow(settings.latency_window, values) for name, values in measured.items()}
        self.feasibility = {name: settings.feasibility(max(measured[name])) for name in settings.tiers}
        tiers = fast_enough(self.feasibility, settings.refuse_infeasible)
        usual = self._policy.info.action.usual
        with self.lock:
            self._state = ExecutorState(settings, usual, tiers, latencies)
        self._ready.set()

    def _next(self) -> Callable[[], object] | None:
        """Wait for what to do: a call, a frame to prepare, a reset of the policy with a seed, or (None) the end."""
        with self.lock:
            state = self._opened_state
            while not self._ending:
                if self._reset_due:
                    seed, self._reset_due, self._reset_seed = self._reset_seed, False, None
                    return partial(self._policy.reset, seed)
                now = self._clock.now()
                start = state.next_start(now)
                if start is not None and start <= now:
                    return partial(self._call, state.begin(now))
                if self._seeing and (frame := state.frame_to_prepare(now)) is not None:
                    state.begin_preparing(frame)
                    return partial(self._prepare, frame)
                self._waiting, self._timed = True, start is not None
                self._clock.wait(self._work, None if start is None else start - now)
                self._waiting = False
        return None

    def _prepare(self, frame: Frame) -> None:
        """Compute what depends on a frame alone, while nothing waits for it; until that is of no use any more."""

        def useless() -> bool:
            with self.lock:
                now = self._clock.now()
                return self._ending or self._reset_due or not self._opened_state.awaits(frame, now)

        start = self._clock.now()
        assert self._seeing is not None  # or there was none to prepare
        work = self._seeing.prepare_frame(self._settings.frames.alone(frame), useless)
        if self._trace.on:
            self._trace.frame(start, self._clock.now(), work)

    def _call(self, job: Job) -> None:
        settings = self._settings
        obs = settings.frames.observation(job.frames)
        prefix = {} if job.prefix is None else {"prefix": job.prefix[None]}
        arguments: dict[str, Any] = {**settings.plan_argument(job.plan), **prefix}
        last = settings.first + settings.horizon + settings.reserve
        if job.stalled:  # all but the sequence of its noise is forgotten
            self._policy.reset()
        elif (follow := getattr(self._policy, "follow", None)) is not None and job.executed is not None:
            follow(job.executed)
        try:
            predicted = np.asarray(self._policy.predict_action(obs, **arguments)["action_pred"])
        except NonFiniteActionsError:  # the guard refuses them, as it does those of a policy that gives them out
            predicted = np.full((1, last, settings.channels), np.nan, np.float32)
        streams, steps, channels = predicted.shape if predicted.ndim == 3 else (0, 0, 0)
        if streams != 1 or steps < last or channels != settings.channels:
            expected = f"[1, T, Da] with T of at least {last} and Da = {settings.channels}"
            raise ExecutorError(f"the policy's action_pred has shape {list(predicted.shape)}; expected {expected}.")
        actions: npt.NDArray[np.float32] = predicted[0, settings.first : last].astype(np.float32)
        report = getattr(self._policy, "last_report", None)
        far = bool(getattr(report, "far", False))
        with self.lock:
            now = self._clock.now()
            outcome = self._opened_state.finish(job, actions, now, far)
            self.news.notify_all()
        if self._trace.on:
            args = {"plan": job.plan, "epoch": job.epoch, "chunk": outcome}
            args |= {"stalled": True} if job.stalled else {}
            args |= {"outside": True} if far else {}
            frames = getattr(report, "frames", None)
            args |= tokens_of(frames)
            if frames is not None and frames.scenes + frames.scenes_remembered:
                args |= {"scenes": frames.scenes, "scenes known": frames.scenes_remembered}
            if self._seeing and frames is not None:
                args |= {"frames": frames.computed, "frames known": frames.remembered, "hidden ms": frames.saved}
            self._trace.call(job.started, now, args, None if report is None else report.timings)

    @property
    def _opened_state(self) -> ExecutorState:
        assert self._state is not None  # ``_open`` made it
        return self._state


def _pin(cores: tuple[int, ...]) -> None:
    if not hasattr(os, "sched_setaffinity"):
        raise ExecutorError("cores cannot be set on this system. Leave ExecutorSettings.cores at None.")
    try:
        os.sched_setaffinity(0, cores)
    except OSError as error:
        usable = sorted(os.sched_getaffinity(os.getpid()))
        problem = f"the policy's thread cannot be pinned to {cores}: {error}"
        raise ExecutorError(f"{problem}. This process may use {usable}.") from error
