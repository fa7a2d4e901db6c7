"""``AsyncExecutor``: the action for *now*, while the next chunk is computed in the background.

Who owns what:

- The *policy*, with its runtime, its caches and its random numbers, belongs to the worker's thread, from the
  constructor to the end of ``close``. Nobody else calls it, but for ``with_tokens``: a reset is a note to the worker.
- The *worker* (``worker.Worker``) belongs to the process that made it.
- The *state* (``state.ExecutorState``) belongs to whoever holds the worker's lock, for microseconds at a time: never
  during a call of the policy, never while frames are copied.
- Two conditions on that lock wake the worker, and those who wait for an action; nothing polls.
- The *trace* takes events from any thread.
- What the worker raises ends it, is kept, and is raised at the next call of anybody.
- A reset counts the *epoch* up. A call carries the epoch that it was started in, and what it computes is thrown away if
  that is over.
"""

import sys
import warnings
import weakref
from collections.abc import Mapping
from numbers import Real
from types import TracebackType
from typing import Any

from ttscompile.core.spec import FloatArray
from ttscompile.errors import ExecutorClosedError, ExecutorError, WorkerDeadError
from ttscompile.runtimes.arrays import check_seed

from .feasibility import Feasibility
from .measure import Clock, MonotonicClock, require_plans
from .settings import ExecutorSettings, Policy, resolve
from .state import ExecutorState
from .statistics import CONTROL, ExecutorStatistics, Trace, statistics
from .window import FrameSpec
from .worker import Worker


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
        latencies: seconds of the longest call of each tier, and of ``stall_plan`` where that may be run, if they are
            known; None has them measured now. A plan that begins with the chunk before makes calls that have none, too.
        open_timeout: seconds, of real time, that this may take.

    Raises:
        ExecutorError: the settings do not fit the policy.
        InfeasibleError: no tier is fast enough; the message has the arithmetic.
        WorkerDeadError: of every method, once the policy's thread has ended; ``__cause__`` says why.
        ExecutorClosedError: of every method but ``statistics`` and ``close``, after ``close``.
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
        settings = settings or ExecutorSettings()
        info = policy.info
        self._resolved = resolve(settings, info, control_hz)
        require_plans(policy, self._resolved)
        self._with_tokens = getattr(policy, "with_tokens", lambda frame: frame)
        self._clock = clock or MonotonicClock()
        self._identity = str(getattr(info, "identity", ""))  # anything that predicts may be driven
        self.trace = Trace(settings.trace_events, self._identity)
        self._failure_told = self._closed = False
        self._worker = Worker(policy, self._resolved, self._clock, self.trace)
        self._finalizer = weakref.finalize(self, self._worker.abandon)
        self._finalizer.atexit = False  # the worker sees to that itself
        self._state = self._worker.open(latencies, open_timeout)

    # The control loop's side

    def observe(self, obs: Mapping[str, Any], t: float | None = None) -> None:
        """Give one frame. Never blocks.

        Args:
            obs: by key, without the axes of batch and time: ``{"obs": float32 [Do]}``. Copied. The text ``task`` may be
                among them if the policy has a tokenizer, which the first text reads; tokens are made when it changes.
            t: when it was taken, on the executor's clock; None for now. Frames may come late and out of order.

        Raises:
            ObservationError: it does not fit the policy, is not finite, or comes from the future.
            ExecutorError: ``t`` is no number.
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        worker = self._here()
        frame, t = self._resolved.frames.check(self._with_tokens(obs)), _seconds(t, "t")
        with worker.lock:
            state = self._checked()
            now = self._clock.now()
            state.observe(frame, now if t is None else t, now)
            worker.look_again(now)

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
            ExecutorError: ``t`` or ``timeout`` is no number.
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        worker, t, timeout = self._here(), _seconds(t, "t"), _seconds(timeout, "timeout")
        with worker.lock:
            state = self._checked()
            start = now = self._clock.now()
            until = now if timeout is None else now + timeout
            reserve = state.recorder.counts.reserve
            while (action := state.play(now if t is None else t, now)) is None and now < until:
                self._clock.wait(worker.news, until - now)
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
            try:
                raise error
            finally:
                del error  # it and this frame would keep each other, and with them all that the caller holds
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
        worker = self._here()
        seed = check_seed(seed)
        with worker.lock:
            state = self._checked()
            state.reset()
            worker.reset(seed)
            if self.trace.on:
                self.trace.instant(CONTROL, "reset", self._clock.now(), {"epoch": state.epoch})

    def close(self, timeout: float = 10.0) -> None:
        """End the thread, after the call that it is in. The policy may be used again after this.

        Closing twice is closing once. Called by the policy itself, this waits for nothing: the thread ends with the
        call. A forked process, where there is no thread to end, does nothing. The handler of a signal may call it.

        Args:
            timeout: seconds, of real time, to wait for it.

        Raises:
            ExecutorError: a call of the policy did not end in time. Its thread is left behind, and ends with the call
                or the process.
            WorkerDeadError: the thread had ended because of an error that nobody was told.
        """
        worker = self._worker
        if worker.process.left:
            return
        self._closed = True
        self._finalizer.detach()
        worker.end()
        if not worker.join(timeout):
            what = f"the policy is still in a call, {timeout:g} s after close(): it hangs, or is slower than that"
            raise ExecutorError(f"{what}. Its thread is left behind; do not use the policy again.")
        if not self._failure_told:
            self._raise_failure()

    def __enter__(self) -> "AsyncExecutor":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except ExecutorError as closing:
            if error is None:
                raise
            note = f"closing the executor failed too: {closing}"
            if sys.version_info >= (3, 11):
                error.add_note(note)
            else:
                warnings.warn(note, stacklevel=2)

    def statistics(self) -> ExecutorStatistics:
        """What happened so far; works after ``close`` too."""
        with self._here().lock:
            plan, copied = self._state.plan, self._state.recorder.copy()
        return statistics(plan, copied, self._identity)

    def feasibility(self) -> dict[str, Feasibility]:
        """The arithmetic of each tier, as measured when the executor was made."""
        return dict(self._worker.feasibility)

    @property
    def ready(self) -> bool:
        """Whether a chunk of this episode has come: from then on, a tick without an action is a fault.

        Raises:
            WorkerDeadError: the policy's thread has ended; ``__cause__`` says why.
            ExecutorClosedError: after ``close``.
        """
        with self._here().lock:
            return self._checked().ready

    @property
    def trouble(self) -> str:
        """Why no action comes: the policy failed, this was closed, frames make no window, or no chunk may be played.

        Empty where one may come. Of an episode that is ``ready`` the error of ``action`` says more.
        """
        failure = self._worker.failure
        if failure is not None:
            return f"the thread that owns the policy has ended: a call raised {type(failure).__name__}: {failure}"
        if self._closed:
            return "the executor was closed"
        with self._here().lock:
            return self._state.trouble(self._clock.now())

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
        self._here()
        counts = self._state.recorder.counts
        return int(counts.reserve + counts.holds)

    def now(self) -> float:
        """Seconds on the executor's clock: what times of observations and actions are compared with."""
        return self._clock.now()

    def _here(self) -> Worker:
        """The worker, unless it is in another process: not even its lock may be waited for then."""
        worker = self._worker
        if worker.process.left:
            what = f"the executor was made in {worker.process}. The thread that calls the policy is not here"
            raise ExecutorError(f"{what}. Load the policy and make an executor in the process that uses them.")
        return worker

    def _checked(self) -> ExecutorState:
        if self._worker.failure is not None:
            self._raise_failure()
        if self._closed:
            raise ExecutorClosedError("the executor was closed. Make another one.")
        return self._state

    def _raise_failure(self) -> None:
        failure = self._worker.failure
        if failure is not None:
            self._failure_told = True
            raised = f"a call raised {type(failure).__name__}: {failure}"
            remedy = "Stop the robot safely; close this executor, and make another one when the cause is gone."
            raise WorkerDeadError(f"the thread that owns the policy has ended, because {raised}. {remedy}") from failure


def _seconds(value: Any, what: str) -> float | None:
    if value is None or isinstance(value, Real):
        return None if value is None else float(value)
    raise ExecutorError(f"{what} is a number of seconds on the executor's clock, or None; found {value!r:.80}.")
