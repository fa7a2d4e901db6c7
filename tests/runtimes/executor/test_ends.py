"""How an executor ends: with the program, forgotten, closed by whomever; and what a forked process is told."""

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
import weakref
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ttscompile.errors import DeadlineMissedError, ExecutorClosedError, ExecutorError, WorkerDeadError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings, MonotonicClock

from .simulation import REAL_LIMIT, FakeClock, ScriptedPolicy, World, workers

LATENCIES = {"dense": 0.1}


def until_no_thread_is_left() -> None:
    limit = time.monotonic() + REAL_LIMIT
    while workers():
        assert time.monotonic() < limit
        time.sleep(0.001)


class Calling(ScriptedPolicy):
    """Its calls do something, in real time."""

    def __init__(self, do: Any) -> None:
        super().__init__(FakeClock())
        self.do = do
        self.inside, self.done = threading.Event(), threading.Event()

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        self.inside.set()
        try:
            self.do()
        finally:
            self.done.set()
        return {"action_pred": np.zeros((1, self.predicted, 3))}


def opened(policy: ScriptedPolicy) -> AsyncExecutor:
    return AsyncExecutor(policy, 10, ExecutorSettings(max_hold=0), latencies=LATENCIES)


def start_a_call(executor: AsyncExecutor) -> None:
    now = executor.now()
    for ago in (0.1, 0.0):
        executor.observe({"obs": np.zeros(2)}, now - ago)


# The end of the executor


def test_an_executor_that_nobody_holds_is_collected_and_its_thread_ends() -> None:
    policy = ScriptedPolicy(FakeClock())
    executor = opened(policy)
    gone = weakref.ref(executor)
    del executor
    gc.collect()
    assert gone() is None
    until_no_thread_is_left()


def test_it_may_be_collected_during_a_call_and_by_its_own_thread() -> None:
    kept: list[AsyncExecutor] = []

    def drop() -> None:
        kept.clear()
        gc.collect()

    policy = Calling(drop)
    kept.append(opened(policy))
    start_a_call(kept[0])
    assert policy.done.wait(REAL_LIMIT)
    until_no_thread_is_left()


def test_a_missing_action_keeps_nothing_of_the_callers() -> None:
    """Control loops often run without garbage collection, and what they hold may be a renderer."""

    def loop(world: World) -> weakref.ref[FakeClock]:
        held = FakeClock()
        with pytest.raises(DeadlineMissedError):
            world.executor.action()
        return weakref.ref(held)

    gc.collect()
    gc.disable()
    try:
        with World() as world:
            assert loop(world)() is None
    finally:
        gc.enable()


def test_the_policy_may_close_the_executor_that_calls_it() -> None:
    policy = Calling(lambda: executor.close())
    executor: AsyncExecutor = opened(policy)
    start_a_call(executor)
    assert policy.done.wait(REAL_LIMIT)
    until_no_thread_is_left()
    with pytest.raises(ExecutorClosedError):
        executor.action()
    executor.close()


def test_the_policy_may_use_the_executor_that_calls_it() -> None:
    seen: list[Any] = []

    def use() -> None:
        executor.observe({"obs": np.zeros(2)})
        seen.extend([executor.ready, executor.statistics().calls])
        executor.reset()

    policy = Calling(use)
    executor = opened(policy)
    start_a_call(executor)
    assert policy.done.wait(REAL_LIMIT)
    executor.close()
    assert seen == [False, 0]


@pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), MemoryError(), StopIteration()])
def test_whatever_a_policy_raises_is_told(error: BaseException) -> None:
    def fail() -> None:
        raise error

    policy = Calling(fail)
    executor = opened(policy)
    start_a_call(executor)
    with pytest.raises(WorkerDeadError, match=f"a call raised {type(error).__name__}") as caught:
        executor.action(timeout=REAL_LIMIT)
    assert caught.value.__cause__ is error
    executor.close()


@pytest.mark.parametrize("during", ["a wait", "a call"])
@pytest.mark.parametrize("raises", [True, False])
def test_the_handler_of_a_signal_may_close_the_executor_that_it_interrupts(during: str, raises: bool) -> None:
    """Which holds its lock then. In real time; the clock stands for any place where the signal may arrive."""
    inside = list[bool]()

    class Signalled(MonotonicClock):
        def now(self) -> float:
            if armed and threading.current_thread() is threading.main_thread():
                armed.clear()
                signal.raise_signal(signal.SIGINT)
            return super().now()

    def handler(*_: object) -> None:
        inside.append(executor._worker.lock._is_owned())  # type: ignore[attr-defined]
        executor.close(timeout=REAL_LIMIT)
        assert workers() == []
        if raises:
            raise KeyError("stopped")

    armed, policy = list[bool](), Calling(lambda: time.sleep(0.2))
    executor = AsyncExecutor(policy, 10, ExecutorSettings(max_hold=0), clock=Signalled(), latencies=LATENCIES)
    before = signal.signal(signal.SIGINT, handler)
    try:
        if during == "a call":
            start_a_call(executor)
            assert policy.inside.wait(REAL_LIMIT)
        armed.append(True)
        with pytest.raises(KeyError, match="stopped") if raises else nullcontext():
            executor.observe({"obs": np.zeros(2)})
    finally:
        signal.signal(signal.SIGINT, before)
    assert inside == [True]
    with pytest.raises(ExecutorClosedError):
        executor.action()


def test_a_clock_that_fails_is_told_to_who_asked_and_everything_goes_on() -> None:
    with World() as world:
        world.begin()
        now = world.clock.now

        def fail() -> float:
            raise OSError("no clock")

        world.clock.now = fail  # type: ignore[method-assign]
        for use in (world.executor.action, lambda: world.executor.observe({"obs": np.zeros(2)}), world.executor.now):
            with pytest.raises(OSError, match="no clock"):
                use()
        world.clock.now = now  # type: ignore[method-assign]
        for _ in range(20):
            assert world.tick() is not None


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="interrupts are sent to the thread")
def test_an_interrupt_while_the_policy_is_measured_leaves_no_thread() -> None:
    def interrupted() -> None:
        if not policy.done.is_set():
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    policy = Calling(interrupted)
    with pytest.raises(KeyboardInterrupt):
        AsyncExecutor(policy, 10, ExecutorSettings(refuse_infeasible=False))
    until_no_thread_is_left()


# The end of the program, and other processes


def program(body: str, artifact: Path) -> subprocess.CompletedProcess[str]:
    """Run a program with an executor under which a long call of a compiled policy is under way."""
    start = """
    import os, signal, sys, threading, time, warnings
    import numpy as np
    from ttscompile import AsyncExecutor, ExecutorSettings, TtscompileError, load
    warnings.simplefilter("ignore", DeprecationWarning)  # newer Pythons warn of any fork beside threads

    class Long:
        def __init__(self, policy):
            self.policy, self.info, self.inside = policy, policy.info, threading.Event()

        def reset(self, seed=None):
            self.policy.reset(seed)

        def predict_action(self, obs, *, plan):
            self.inside.set()
            until = time.monotonic() + 0.3
            while time.monotonic() < until:
                made = self.policy.predict_action(obs, plan=plan)
            return made

    policy = Long(load(sys.argv[1], seed=0))
    executor = AsyncExecutor(policy, 10, ExecutorSettings(refuse_infeasible=False), latencies={"dense": 0.01})
    frame = {"obs": np.zeros(2, np.float32)}
    executor.observe(frame)
    policy.inside.wait()
    """
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(start) + textwrap.dedent(body), str(artifact)],
        capture_output=True,
        text=True,
        timeout=REAL_LIMIT * 3,
        check=False,
        cwd=Path(__file__).parents[3],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "status", "last"),
    [
        ("", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("raise ValueError('mine')", 1, "ValueError: mine"),
        ("signal.raise_signal(signal.SIGINT)", -2, "KeyboardInterrupt"),
        ("ended = threading.Thread(target=sys.exit, args=(5,)); ended.start(); ended.join(); sys.exit(4)", 4, ""),
        ("del executor; sys.exit(6)", 6, ""),
    ],
)
def test_the_exit_status_is_the_programs_though_a_call_is_under_way(
    toy_compiled: Path, body: str, status: int, last: str
) -> None:
    done = program(body, toy_compiled)
    assert done.returncode in (status, 130 if status == -2 else status)
    assert done.stderr.splitlines()[-1:] == ([last] if last else [])


@pytest.mark.slow
def test_control_loops_on_other_threads_go_on_after_the_main_thread_or_end_with_it(toy_compiled: Path) -> None:
    body = """
    def loop(ticks):
        for _ in range(ticks):
            executor.observe(frame)
            try:
                executor.action()
            except TtscompileError:
                pass
            time.sleep(0.01)
        print(threading.main_thread().is_alive(), executor.statistics().calls > before)

    before = executor.statistics().calls
    threading.Thread(target=loop, args=(100,)).start()
    threading.Thread(target=loop, args=(10**9,), daemon=True).start()
    """
    done = program(body, toy_compiled)
    assert (done.returncode, done.stdout, done.stderr) == (0, "False True\n", "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_an_executor_in_a_forked_process_says_so_even_if_its_lock_is_held_for_ever(toy_compiled: Path) -> None:
    body = """
    parent = os.getpid()
    executor._worker.lock.acquire()  # as the thread may, at the moment of the fork
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        with executor:
            uses = [executor.observe, lambda _: executor.action(), lambda _: executor.reset(), lambda _: executor.ready]
            for use in [*uses, lambda _: executor.statistics(), lambda _: executor.bridged]:
                try:
                    use(frame)
                except TtscompileError as error:
                    print(f"made in process {parent};" in str(error) and "make an executor in" in str(error))
        sys.exit(7)
    executor._worker.lock.release()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    executor.observe(frame)
    executor.close()
    """
    done = program(body, toy_compiled)
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, ["True"] * 6 + ["7"], "")


@pytest.mark.parametrize("latency", ["x", None, -0.1, float("nan")])
def test_a_latency_that_is_none_is_refused(latency: Any) -> None:
    with pytest.raises(ExecutorError, match="the latency of plan 'dense' must be a number, of seconds; found"):
        AsyncExecutor(ScriptedPolicy(FakeClock()), 10, latencies={"dense": latency})


def test_no_guard_is_none() -> None:
    with pytest.raises(ExecutorError, match="the guard must be GuardLimits; found None"):
        AsyncExecutor(ScriptedPolicy(FakeClock()), 10, ExecutorSettings(guard=None), latencies=LATENCIES)  # type: ignore[arg-type]
