"""How a call runs: the pruner beside step 0, what a failure leaves, the first call, callers on several threads."""

import gc
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.plans import store_schedules
from ttscompile import Noise, Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.manifest import WeightsRecord
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.runtimes import Runtime, open_runtime
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.workspace import Workspace

from .agreement import assert_alike, random_inputs
from .buffers import nbytes, rollout_nbytes
from .conftest import Failure, MakeArtifact, failing_prologue
from .toys import toy_program

HELPER = "ttscompile-pruner"


def helpers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith(HELPER)]


def call(runtime: Runtime, artifact: Artifact, seed: int, plan: np.ndarray | None = None) -> np.ndarray:
    return runtime.predict(*random_inputs(artifact, np.random.default_rng(seed), 2), Plan(cells=plan))[0]


@pytest.mark.slow
def test_the_pruners_thread_is_made_at_load_and_lives_as_long_as_the_runtime(pruned: Artifact) -> None:
    before = len(helpers())
    runtime = open_runtime(pruned)
    mine = helpers()[before:]
    assert len(mine) == 1
    for seed in range(3):
        call(runtime, pruned, seed)
    assert helpers()[before:] == mine
    del runtime
    gc.collect()
    mine[0].join(timeout=10)
    assert not mine[0].is_alive()


def test_there_is_no_such_thread_where_no_plan_is_the_pruners(toy_artifact: Artifact) -> None:
    before = helpers()
    runtime = open_runtime(toy_artifact)
    call(runtime, toy_artifact, 0, dense_plan(5, 5))
    assert helpers() == before


def test_step_0_does_not_wait_for_the_pruner(pruned: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = open_runtime(pruned)
    expected = call(runtime, pruned, 0)
    done_first, real = threading.Event(), Workspace.logits
    last = Workspace.run_dense

    def late(self: Workspace) -> np.ndarray:
        assert done_first.wait(timeout=30), "step 0 waits for the pruner"
        return real(self)

    def run(self: Workspace, k: int) -> None:
        last(self, k)
        if k == 0:
            done_first.set()

    runtime.reset()
    with monkeypatch.context() as patched:
        patched.setattr(Workspace, "logits", late)
        patched.setattr(Workspace, "run_dense", run)
        sample, report = runtime.predict(*random_inputs(pruned, np.random.default_rng(0), 2), Plan(repair=True))
    assert np.array_equal(sample, expected)
    timings = report.timings
    assert min(timings.wait_pruner, timings.pruner) > 0
    assert timings.total == pytest.approx(timings.prologue + timings.wait_pruner + timings.decode)


@pytest.mark.parametrize("thread", ["helper", "caller"])
def test_a_failure_on_either_thread_comes_to_the_caller_and_ends_the_episode(
    pruned: Artifact, monkeypatch: pytest.MonkeyPatch, thread: str
) -> None:
    runtime = open_runtime(pruned)
    first = call(runtime, pruned, 0)
    finished = threading.Event()

    def fail(*_: object) -> None:
        raise Failure

    def slow(self: Workspace) -> np.ndarray:
        threading.Event().wait(0.05)
        finished.set()
        return np.zeros((2, 5, 5, 4), np.float32)

    with monkeypatch.context() as patched:
        patched.setattr(Workspace, "logits", fail if thread == "helper" else slow)
        if thread == "caller":
            patched.setattr(Workspace, "begin", fail)
        with pytest.raises(Failure):
            call(runtime, pruned, 1)
    assert thread == "helper" or finished.is_set()  # nobody reads the workspace any more
    assert runtime.streams is None
    assert np.array_equal(call(runtime, pruned, 0), first)


@pytest.mark.parametrize("name", ["onnxruntime", "torch", "reference"])
def test_a_prologue_that_fails_ends_the_episode(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    runtime = open_runtime(toy_artifact, name)
    dense, reuse = dense_plan(5, 5), dense_plan(5, 5)
    reuse[1:] = Source.ROLLOUT
    call(runtime, toy_artifact, 0, dense)
    with pytest.raises(IllegalPlanError):
        call(runtime, toy_artifact, 0, dense[:, :4])
    call(runtime, toy_artifact, 0, reuse)  # what was refused before it began changed nothing
    with failing_prologue(monkeypatch), pytest.raises((Failure, ArtifactError)) as caught:
        call(runtime, toy_artifact, 0, dense)
    assert isinstance(caught.value, Failure) or isinstance(caught.value.__cause__, Failure)
    assert runtime.streams is None
    with pytest.raises(IllegalPlanError, match="never computed"):
        call(runtime, toy_artifact, 0, reuse)


def test_weights_that_find_no_memory_read_nothing_of_others(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plan with weights of its own has a backend of its own, which never computed what the other's calls have."""
    weights = dict.fromkeys(["distilled"], WeightsRecord("none", {}, None, {}))
    given = replace(
        toy_artifact, manifest=replace(toy_artifact.manifest, weights=weights), block_weights={"distilled": {}}
    )
    runtime, (obs, noise) = open_runtime(given), random_inputs(toy_artifact, np.random.default_rng(0), 1)
    reuse = dense_plan(5, 5)
    reuse[1:] = Source.ROLLOUT
    runtime.predict(obs, noise, given.plans["dense"])

    def full(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(OnnxBackend, "prepare", full)
        with pytest.raises(MemoryError):
            runtime.predict(obs, noise, Plan(cells=reuse * 0, weights="distilled"))
    with pytest.raises(IllegalPlanError, match="never computed"):
        runtime.predict(obs, noise, Plan(cells=reuse, weights="distilled"))


def test_the_interpreter_ends_with_a_runtime_open(pruned: Artifact) -> None:
    code = f"""
    from ttscompile.artifact import load_artifact
    from ttscompile.runtimes import open_runtime
    kept = open_runtime(load_artifact({str(pruned.path)!r}))
    print("open")
    """
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(code)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, cwd=Path(__file__).parents[2]
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "open\n", "")


def test_two_runtimes_work_at_the_same_time(pruned: Artifact) -> None:
    def episode(seed: int) -> list[np.ndarray]:
        runtime = open_runtime(pruned)
        return [call(runtime, pruned, seed + i) for i in range(20)]

    alone = [episode(seed) for seed in (0, 100)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(episode, (0, 100)))
    assert all(np.array_equal(a, b) for x, y in zip(alone, together, strict=True) for a, b in zip(x, y, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("whole_steps", [True, False])
def test_a_first_call_with_a_schedule_binds_nothing(
    make_artifact: MakeArtifact, monkeypatch: pytest.MonkeyPatch, whole_steps: bool
) -> None:
    """What a session is bound to is settled at load; a call that binds costs many times a warm one."""
    from ttscompile.runtimes.onnxruntime import idle_steps, workspace

    schedule = uniform_plan(5, 5, 2)
    if not whole_steps:
        schedule[3, 1] = Source.COMPUTE
    path = make_artifact(toy_program(pruner=False, normed=True)).path
    store_schedules(path, None, {"mine": schedule}, "mine", {"learned": ["schedule"]})
    artifact = load_artifact(path)
    runtime = open_runtime(artifact)
    assert isinstance(runtime.backend, OnnxBackend)
    assert ("block_00" in runtime.backend.sessions) is not whole_steps
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)

    def bind(*_: object) -> None:
        raise AssertionError("a session was bound during a call")

    for module in (workspace, idle_steps):
        monkeypatch.setattr(module, "Bound", bind)
    for _ in range(2):
        runtime.predict(obs, noise, artifact.plans["mine"])
        runtime.reset()


def test_single_blocks_are_opened_by_the_first_plan_that_needs_them(toy_artifact: Artifact) -> None:
    runtime, other = open_runtime(toy_artifact), open_runtime(toy_artifact, "reference")
    assert isinstance(runtime.backend, OnnxBackend)
    runtime.predict(*random_inputs(toy_artifact, np.random.default_rng(0), 1), Plan(cells=uniform_plan(5, 5, 3)))
    assert "block_00" not in runtime.backend.sessions
    runtime.reset()
    partial = uniform_plan(5, 5, 3)
    partial[4, 2] = Source.COMPUTE
    assert_alike(toy_artifact, (runtime, other), Plan(cells=partial), np.random.default_rng(0))
    assert "block_00" in runtime.backend.sessions


def test_streams_that_compute_whole_steps_need_no_single_blocks(toy_artifact: Artifact) -> None:
    runtime, other = open_runtime(toy_artifact), open_runtime(toy_artifact, "reference")
    assert isinstance(runtime.backend, OnnxBackend)
    plans = np.stack([uniform_plan(5, 5, n) for n in (1, 2, 3)])
    assert_alike(toy_artifact, (runtime, other), Plan(cells=plans), np.random.default_rng(0), 3)
    assert "block_00" not in runtime.backend.sessions


def test_single_blocks_of_an_artifact_that_has_changed_since_are_refused(own_artifact: Artifact) -> None:
    runtime = open_runtime(own_artifact)
    obs, noise = random_inputs(own_artifact, np.random.default_rng(0), 1)
    partial = uniform_plan(5, 5, 3)
    partial[4, 2] = Source.COMPUTE
    path = own_artifact.path / own_artifact.manifest.pieces["block_02"].file
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(ArtifactError, match=r"since it was loaded \(block_02\.onnx\)"):
        runtime.predict(obs, noise, Plan(cells=partial))
    assert runtime.predict(obs, noise, Plan(cells=uniform_plan(5, 5, 3)))[1].computed == (15,)


def test_a_batch_that_finds_no_memory_leaves_a_runtime_that_works(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = open_runtime(toy_artifact)
    obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), 2)

    def full(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr("ttscompile.runtimes.onnxruntime.backend.Workspace", full)
        with pytest.raises(MemoryError):
            runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))
    assert isinstance(runtime.backend, OnnxBackend)
    assert runtime.backend.workspace is None
    assert runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))[1].computed == (25, 25)


def test_a_workspace_is_given_back_when_the_batch_changes(toy_artifact: Artifact) -> None:
    runtime = open_runtime(toy_artifact)
    assert isinstance(runtime.backend, OnnxBackend)
    assert rollout_nbytes(runtime) == 0
    sizes = []
    for streams in (1, 4, 2):
        obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), streams)
        runtime.predict(obs, Noise(noise.initial, noise.steps), Plan(cells=dense_plan(5, 5)))
        assert rollout_nbytes(runtime) == 25 * streams * 3 * 4 * 4
        sizes.append(nbytes(runtime.backend.workspace))
        runtime.reset()
    assert sizes[0] < sizes[2] < sizes[1] <= 4 * sizes[0]
