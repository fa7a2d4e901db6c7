"""A policy in a process that was forked, at the end of the interpreter, and under odd environment variables."""

import copy
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ttscompile.artifact import Artifact, load_artifact
from ttscompile.errors import RuntimeUnavailableError, TtscompileError
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.load import load

OBS = np.array([[0.3, -1.2]], np.float32)

forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")


def program(code: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program that has ``OBS``, ``load`` and ``forked(do)``, which says how a child that does it ends."""
    start = """
    import gc, os, signal, sys, threading, warnings
    import numpy as np
    from ttscompile import TtscompileError, load
    OBS = {"obs": np.array([[0.3, -1.2]], np.float32)}
    warnings.simplefilter("ignore", DeprecationWarning)  # newer Pythons warn of any fork beside threads

    def forked(do):
        child = os.fork()
        if child == 0:
            signal.alarm(20)  # so much for a child that hangs
            do()
            sys.exit(7)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    """
    whole = textwrap.dedent(start) + textwrap.dedent(code)
    return subprocess.run(
        [sys.executable, "-c", whole, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=Path(__file__).parents[2],
        env=os.environ | environment,
    )


@pytest.mark.slow
@forks
@pytest.mark.parametrize("threads", [1, 2])
def test_a_forked_child_is_told_to_load_the_policy_itself_and_can(pruned: Artifact, threads: int) -> None:
    """Threads of the pruner and of onnxruntime are not in the child; there the old policy must not even be let go."""
    code = """
    path, threads = sys.argv[1], int(sys.argv[2])
    policy = load(path, threads=threads, seed=0)
    before = policy.predict_action(OBS)["action"]

    def child():
        global policy
        for call in (lambda: policy.predict_action(OBS), policy.reset):
            try:
                call()
            except TtscompileError as error:
                print(error, flush=True)
        policy = load(path, threads=threads, seed=0)
        gc.collect()
        print((policy.predict_action(OBS)["action"] == before).all(), flush=True)

    print(forked(child), os.getpid())
    policy.reset(seed=0)
    print((policy.predict_action(OBS)["action"] == before).all())
    """
    done = program(code, pruned.path, threads)
    *told, same, ended, again = done.stdout.splitlines()
    status, parent = ended.split()
    assert (same, status, again, done.stderr) == ("True", "7", "True", "")
    assert len(told) == 2
    assert all(f"was loaded in process {parent}; this is process " in each for each in told)
    assert all(each.endswith("Load the policy in the process that calls it, after the fork.") for each in told)


@forks
def test_workers_of_multiprocessing(pruned: Artifact) -> None:
    """A policy of the parent's is refused, and each worker may load its own."""
    code = """
    import multiprocessing
    policy = load(sys.argv[1], threads=2, seed=0)

    def inherited(_):
        return policy.predict_action(OBS)["action"]

    def begin():
        global policy
        policy = load(sys.argv[1], threads=2, seed=0)

    context = multiprocessing.get_context("fork")
    with context.Pool(2) as pool:
        try:
            pool.map_async(inherited, range(4)).get(20)
        except TtscompileError as error:
            print("refused" if "a fork of it" in str(error) else error)
    with context.Pool(2, begin) as pool:
        print(len(pool.map_async(inherited, range(4)).get(20)))
    """
    done = program(code, pruned.path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "refused\n4\n", "")


@forks
def test_a_fork_during_a_call_is_told_the_same(pruned: Artifact) -> None:
    code = """
    policy = load(sys.argv[1])
    with policy._turn():
        def child():
            try:
                policy.reset()
            except TtscompileError as error:
                print("fork" in str(error), flush=True)
        print(forked(child))
    """
    done = program(code, pruned.path)
    assert (done.stdout, done.stderr) == ("True\n7\n", "")


@forks
def test_the_end_of_a_forked_child_leaves_the_files_of_its_parent(pruned: Artifact, tmp_path: Path) -> None:
    code = """
    policy = load(sys.argv[1])
    folder = policy._artifact.path
    print(forked(lambda: None), folder.exists())
    del policy
    gc.collect()
    print(folder.exists())
    """
    done = program(code, shutil.make_archive(str(tmp_path / "zipped"), "zip", pruned.path))
    assert (done.stdout, done.stderr) == ("7 True\nFalse\n", "")


def test_a_policy_is_neither_copied_nor_sent(pruned: Artifact) -> None:
    policy = load(pruned.path)
    with pytest.raises(TtscompileError, match=r"nor sent to another process\. Load it again, where it is called"):
        pickle.dumps(policy)


def test_a_plan_can_be_copied_and_sent(pruned: Artifact) -> None:
    policy = load(pruned.path)
    start = replace(policy.plans["dense"], precision={"blocks": "int8"}, otherwise=policy.plans["dense"])
    for sent in (pickle.loads(pickle.dumps(start)), copy.deepcopy(start)):
        assert sent.variant == start.variant
        assert sent.otherwise is not None
        np.testing.assert_array_equal(sent.cells, start.cells)
        answers = []
        for plan in (sent.otherwise, "dense"):
            policy.reset(seed=0)
            answers.append(policy.predict_action({"obs": OBS}, plan=plan)["action"])
        np.testing.assert_array_equal(*answers)


def test_the_exit_status_is_the_programs_though_a_daemon_thread_calls_the_policy(pruned: Artifact) -> None:
    code = """
    policy = load(sys.argv[1])
    called = threading.Event()

    def calls():
        while True:
            policy.predict_action(OBS)
            called.set()

    threading.Thread(target=calls, daemon=True).start()
    called.wait()
    sys.exit(5)
    """
    done = program(code, pruned.path)
    assert (done.returncode, done.stderr) == (5, "")


def test_threads_call_the_policy_after_the_main_thread_has_ended(pruned: Artifact) -> None:
    code = """
    policy, ended = load(sys.argv[1]), threading.main_thread().join

    def calls():
        ended()
        print(policy.predict_action(OBS)["action"].shape)

    threading.Thread(target=calls).start()
    """
    done = program(code, pruned.path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "(1, 2, 2)\n", "")


def test_a_call_at_the_end_is_made_by_handlers_that_were_registered_after_the_policy_was_loaded(
    pruned: Artifact,
) -> None:
    code = """
    import atexit

    def last(name):
        try:
            print(name, policy.predict_action(OBS)["action"].shape)
        except TtscompileError as error:
            print(name, error)

    atexit.register(last, "before:")
    policy = load(sys.argv[1])
    atexit.register(last, "after:")
    """
    done = program(code, pruned.path)
    after, before = done.stdout.splitlines()
    assert (done.returncode, after, done.stderr) == (0, "after: (1, 2, 2)", "")
    assert before.startswith("before: the program is ending, and the policy makes no more calls. Register")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted in /proc")
@pytest.mark.parametrize(
    "environment",
    [
        {"OMP_NUM_THREADS": "0", "OMP_WAIT_POLICY": "ACTIVE", "OMP_DYNAMIC": "true"},
        {"OMP_NUM_THREADS": "garbage", "ORT_INTRA_OP_NUM_THREADS": "4", "ORT_INTER_OP_NUM_THREADS": "4"},
    ],
)
def test_the_environment_changes_neither_threads_nor_actions(pruned: Artifact, environment: dict[str, str]) -> None:
    code = """
    policy = load(sys.argv[1], seed=0)
    print(policy.predict_action(OBS)["action"].tobytes().hex())
    print([t.name for t in threading.enumerate()], "torch" in sys.modules)
    import onnxruntime
    before = len(os.listdir("/proc/self/task"))
    other = load(sys.argv[1], plan="dense")
    print(len(os.listdir("/proc/self/task")) - before)
    """
    policy = load(pruned.path, seed=0)
    expected = policy.predict_action({"obs": OBS})["action"].tobytes().hex()
    done = program(code, pruned.path, **environment)
    threads = "['MainThread', 'ttscompile-pruner'] False"
    assert (done.stdout.splitlines(), done.stderr) == ([expected, threads, "1"], "")


def test_a_variable_that_has_onnxruntime_ignore_its_options_is_refused(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    for harmless in ("", "0"):
        monkeypatch.setenv("ORT_LOAD_CONFIG_FROM_MODEL", harmless)
        open_runtime(load_artifact(toy_artifact.path))
    monkeypatch.setenv("ORT_LOAD_CONFIG_FROM_MODEL", "1")
    with pytest.raises(RuntimeUnavailableError, match=r"ORT_LOAD_CONFIG_FROM_MODEL has onnxruntime ignore .* Unset it"):
        open_runtime(load_artifact(toy_artifact.path))
