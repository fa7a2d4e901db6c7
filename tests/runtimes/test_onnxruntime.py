"""The onnxruntime runtime on toys: same answers as the reference, reports, threads, what is left after a failure."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding, bound
from tests.verification.broken import edit_manifest
from ttscompile import Noise, Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.core.lattice import PlanArray, dense_plan, legalize, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactError, IllegalPlanError, ObservationError, RuntimeUnavailableError
from ttscompile.ir.program import Binding
from ttscompile.runtimes import Runtime, open_runtime
from ttscompile.runtimes.instructions import Instructions, instructions_of
from ttscompile.runtimes.load import load
from ttscompile.runtimes.onnxruntime.workspace import Workspace

from .agreement import call_terms, each_alone, largest_difference, random_inputs
from .conftest import MakeArtifact
from .toys import f32, pencil_program, toy_program

C, F, T, R = Source.COMPUTE, Source.FORWARD, Source.TIMESTEP, Source.ROLLOUT


@pytest.fixture(params=["onnxruntime", "torch", "reference"])
def runtime(request: pytest.FixtureRequest, toy_artifact: Artifact) -> Runtime:
    return open_runtime(toy_artifact, request.param)


@pytest.mark.parametrize("name", ["onnxruntime", "torch", "reference"])
def test_reuse_gives_41_and_compute_gives_44(pencil_artifact: Artifact, name: str) -> None:
    runtime = open_runtime(pencil_artifact, name)

    def call(x: float, plan: list[Source]) -> float:
        obs = {"obs": np.array([[-32]], np.float32)}
        sample, _ = runtime.predict(obs, Noise(np.full((1, 1, 1), x, np.float32)), Plan(cells=np.array(plan)[:, None]))
        return float(sample[0, 0, 0])

    assert call(35, [C, T]) == 41
    assert call(35, [C, F]) == 41
    assert call(35, [C, C]) == 44  # computes f(38) = 6 at step 1
    assert call(40, [C, T]) == 40 + 8 + 8
    assert call(33, [C, R]) == 33 + 1 + 6  # of the third call: the fourth computed nothing at step 1
    runtime.reset()
    with pytest.raises(IllegalPlanError, match="never computed"):
        call(33, [C, R])
    assert call(35, [C, C]) == 44


def test_a_schedule_is_lowered_once_at_load_and_never_in_a_call(
    own_artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedules = {"half": uniform_plan(5, 5, 2), "most": uniform_plan(5, 5, 4)}
    store_schedules(own_artifact.path, None, schedules, "half", {"learned": ["uniform"]})
    lowered: list[bytes] = []

    def counted(plan: PlanArray, groups: tuple[int, ...]) -> Instructions:
        lowered.append(plan.tobytes())
        return instructions_of(plan, groups)

    monkeypatch.setattr("ttscompile.runtimes.onnxruntime.backend.instructions_of", counted)
    policy = load(own_artifact.path)
    assert sorted(lowered) == sorted(plan.tobytes() for plan in schedules.values())
    for name in policy.info.plans:
        policy.predict_action({"obs": np.zeros((1, 2), np.float32)}, plan=name)
    assert len(lowered) == len(set(lowered)) >= 2


@pytest.mark.slow
def test_a_value_of_the_step_may_be_one_number(make_artifact: MakeArtifact) -> None:
    program = pencil_program()
    pieces = program.pieces
    (block,) = pieces.blocks
    nodes = tuple(node.renamed(lambda name: "time" if name == "offset" else name) for node in block.graph.nodes)
    pieces = replace(
        pieces,
        blocks=(replace(block, graph=replace(block.graph, inputs={"h0": block.type, "time": f32()}, nodes=nodes)),),
        tables={"time": np.array([-32, -31], np.float32)},  # as timestep[0] gives it
        bindings={**pieces.bindings, "time": Binding.TABLE},
    )
    artifact = make_artifact(replace(program, pieces=pieces))
    for name in ("onnxruntime", "torch", "reference"):
        noise = Noise(np.array([[[35]], [[33]]], np.float32))
        obs = {"obs": np.zeros((2, 1), np.float32)}
        sample, _ = open_runtime(artifact, name).predict(obs, noise, Plan(cells=np.array([[C], [C]])))
        assert sample.ravel().tolist() == [35 + 3 + 7, 33 + 1 + 3]


VARIANTS = [{}, {"noise": 0.0, "steps": 8}, {"steps": 1}, {"blocks": 1}, {"sequence_first": True}]


@pytest.mark.slow
@pytest.mark.parametrize("variant", [*VARIANTS, {"normed": True, "sequence_first": True}], ids=str)
def test_they_agree_with_the_reference(make_artifact: MakeArtifact, variant: dict[str, Any]) -> None:
    """Batches of one to four streams, each with a plan of its own or all with the same."""
    artifact = make_artifact(toy_program(**variant, pruner=False))
    reference, allowed = open_runtime(artifact, "reference"), bound(call_terms(artifact))
    for name, seeds in (("onnxruntime", 12), ("torch", 5)):
        runtime = open_runtime(artifact, name)
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            assert largest_difference(artifact, runtime, reference, rng, streams=1 + seed % 4, calls=4) < allowed


def test_a_batch_of_streams_is_its_streams_one_by_one(toy_artifact: Artifact) -> None:
    for beside, alone in each_alone(toy_artifact, np.random.default_rng(0), 3, calls=4):
        assert_equal_but_for_rounding(beside, alone, call_terms(toy_artifact))


def test_the_report_says_what_was_done(runtime: Runtime, toy_artifact: Artifact) -> None:
    manifest = toy_artifact.manifest
    plans = np.stack([dense_plan(5, 5), uniform_plan(5, 5, 2)])
    obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), 2)
    _, report = runtime.predict(obs, noise, Plan(cells=plans))
    assert np.array_equal(report.plan, plans)
    assert not report.plan.flags.writeable
    assert (report.plan_name, report.computed, report.legalised) == ("given", (25, 10), (0, 0))
    loop = 5 * (manifest.flops.stem + manifest.flops.tail)
    dense, sparse = report.flops
    assert dense == manifest.flops.prologue + loop + 5 * sum(manifest.flops.blocks)
    assert dense - sparse == 3 * sum(manifest.flops.blocks) > 0
    timings = report.timings
    assert timings.pruner == timings.wait_pruner == 0
    assert 0 < timings.prologue < timings.total
    assert timings.total == pytest.approx(timings.prologue + timings.decode, rel=0.05)


def test_the_pruners_plan_is_legalised_and_counted(runtime: Runtime, toy_artifact: Artifact) -> None:
    reference: Any = open_runtime(toy_artifact, "reference")
    manifest = toy_artifact.manifest
    rng = np.random.default_rng(1)
    written = np.zeros((2, 5, 5), np.bool_)
    repaired = []
    for _ in range(3):
        obs, noise = random_inputs(toy_artifact, rng, 2)
        _, report = runtime.predict(obs, noise, Plan(repair=True))
        reference.predict(obs, noise, Plan(cells=report.plan))  # refuses an illegal plan
        model = reference.backend.model
        import torch

        wanted = model.logits(model.prologue({"obs": torch.from_numpy(obs["obs"])})).argmax(-1).numpy().astype(np.int8)
        expected, _ = legalize(wanted, manifest.groups, written)
        assert np.array_equal(report.plan, expected)
        assert report.legalised == tuple((wanted != expected).sum(axis=(1, 2)))
        assert report.plan_name == "given"
        assert report.flops == tuple(manifest.flops.call(plan, True) for plan in expected)
        assert 0 < report.timings.pruner <= report.timings.total
        repaired.append(sum(report.legalised))
        written |= expected == C
    assert repaired[0] > 0
    assert set(np.unique(expected)) == {0, 1, 2, 3}


def test_an_illegal_plan_names_its_stream_and_changes_nothing(runtime: Runtime, toy_artifact: Artifact) -> None:
    obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), 2)
    first, _ = runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))
    bad = np.stack([dense_plan(5, 5), np.full((5, 5), T, np.int8)])
    with pytest.raises(IllegalPlanError, match="stream 1 is illegal at step 0"):
        runtime.predict(obs, noise, Plan(cells=bad))
    reuse = dense_plan(5, 5)
    reuse[1:] = R
    again, _ = runtime.predict(obs, noise, Plan(cells=reuse))  # the first call's residuals are still there
    assert_equal_but_for_rounding(again, first, call_terms(toy_artifact))


def test_noise_of_the_wrong_shape_is_refused(runtime: Runtime, toy_artifact: Artifact) -> None:
    obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), 2)
    with pytest.raises(ObservationError, match=r"noise\.initial must be float32 .*; found float32 \[2, 3, 1\]"):
        runtime.predict(obs, Noise(noise.initial[..., :1], noise.steps), Plan(cells=dense_plan(5, 5)))
    assert noise.steps is not None
    with pytest.raises(ObservationError, match=r"noise\.steps must be float32 .*; found float32 \[4, 2, 3, 2\]"):
        runtime.predict(obs, Noise(noise.initial, noise.steps[1:]), Plan(cells=dense_plan(5, 5)))
    with pytest.raises(ObservationError, match=r"noise.steps is missing.*\[K, B, T, D\] = \(5, 2, 3, 2\)"):
        runtime.predict(obs, Noise(noise.initial), Plan(cells=dense_plan(5, 5)))


def test_what_a_call_gave_stays_as_it_was(runtime: Runtime, toy_artifact: Artifact) -> None:
    rng = np.random.default_rng(0)
    sample, report = runtime.predict(*random_inputs(toy_artifact, rng, 2), Plan(repair=True))
    kept, plan = sample.copy(), report.plan.copy()
    runtime.predict(*random_inputs(toy_artifact, rng, 2), Plan(repair=True))
    assert np.array_equal(sample, kept)
    assert np.array_equal(report.plan, plan)


@pytest.mark.parametrize("name", ["onnxruntime", "torch", "reference"])
def test_a_sample_of_one_dimension_stays_as_it_was(pencil_artifact: Artifact, name: str) -> None:
    """Its transposition moves nothing in memory."""
    runtime = open_runtime(pencil_artifact, name)
    obs = {"obs": np.array([[-32]], np.float32)}
    sample, _ = runtime.predict(obs, Noise(np.full((1, 1, 1), 35, np.float32)), Plan(cells=dense_plan(2, 1)))
    runtime.predict(obs, Noise(np.full((1, 1, 1), 40, np.float32)), Plan(cells=dense_plan(2, 1)))
    assert sample.item() == 44


def test_a_call_that_fails_half_way_ends_the_episode(toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = open_runtime(toy_artifact)
    obs, noise = random_inputs(toy_artifact, np.random.default_rng(0), 2)
    first, _ = runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))

    def interrupted(self: Workspace) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Workspace, "begin", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))
    assert runtime.streams is None
    rollout = dense_plan(5, 5)
    rollout[1:] = R
    with pytest.raises(IllegalPlanError, match="never computed"):
        runtime.predict(obs, noise, Plan(cells=rollout))
    assert np.array_equal(runtime.predict(obs, noise, Plan(cells=dense_plan(5, 5)))[0], first)


def test_without_a_pruner_a_plan_is_needed(make_artifact: MakeArtifact) -> None:
    artifact = make_artifact(toy_program(pruner=False))
    for name in ("onnxruntime", "torch", "reference"):
        runtime = open_runtime(artifact, name)
        with pytest.raises(IllegalPlanError, match="needs a pruner"):
            runtime.predict(*random_inputs(artifact, np.random.default_rng(0), 1), Plan(repair=True))


def test_a_pruner_that_gives_nan_is_refused(make_artifact: MakeArtifact) -> None:
    program = toy_program()
    program.weights["pruner.b"][-1] = np.nan
    artifact = make_artifact(program)
    for name in ("onnxruntime", "torch", "reference"):
        with pytest.raises(IllegalPlanError, match="NaN"):
            open_runtime(artifact, name).predict(
                *random_inputs(artifact, np.random.default_rng(0), 1), Plan(repair=True)
            )


@pytest.mark.parametrize(
    ("runtime_name", "threads"), [("tensorrt", 1), ("onnxruntime", 0), ("onnxruntime", True), ("onnxruntime", 100_000)]
)
def test_what_cannot_be_had_is_refused(toy_artifact: Artifact, runtime_name: str, threads: int) -> None:
    with pytest.raises(RuntimeUnavailableError, match="expected one of|at least 1"):
        open_runtime(toy_artifact, runtime_name, threads)


@pytest.mark.parametrize(
    ("name", "package"), [("onnxruntime", "onnxruntime"), ("reference", "torch"), ("torch", "torch")]
)
def test_a_missing_package_is_named(toy_artifact: Artifact, name: str, package: str) -> None:
    code = f"""
import sys
sys.modules[{package!r}] = None
from ttscompile.artifact import load_artifact
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.runtimes import open_runtime
try:
    open_runtime(load_artifact({str(toy_artifact.path)!r}), {name!r})
except RuntimeUnavailableError as error:
    print(error)
"""
    assert f"{name!r} needs" in python(code)


def test_a_graph_that_onnxruntime_refuses_is_an_artifact_error(
    own_artifact: Artifact, capfd: pytest.CaptureFixture[str]
) -> None:
    path = own_artifact.path / own_artifact.manifest.pieces["dense_step"].file
    path.write_bytes(b"")
    edit_manifest(path.parent)
    with pytest.raises(ArtifactError, match=rf"^{path}: onnxruntime .* cannot load"):
        open_runtime(load_artifact(path.parent))
    assert capfd.readouterr().out == ""


def test_weights_that_are_a_link_out_of_the_folder(own_artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime refuses that from 1.24 on; what helps is another thing than for a graph that it cannot read."""
    told = "External data path validation failed: External data path escapes model directory."

    def refuse(*_: object, **__: object) -> None:
        raise ValueError(told)

    monkeypatch.setattr(onnxruntime, "InferenceSession", refuse)
    with pytest.raises(ArtifactError, match=r"leads out of the artifact's folder\. Put the file there: cp -L\.$"):
        load(own_artifact.path)
    told = "no such operation"
    with pytest.raises(ArtifactError, match="cannot load this graph: no such operation"):
        load(own_artifact.path)


def python(code: str) -> str:
    """Standard output of a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


THREADS = """
import os, sys
from ttscompile.artifact import load_artifact
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.runtimes import open_runtime
artifact = load_artifact({path!r})
import onnxruntime
def count():
    return len(os.listdir("/proc/self/task"))
before = count()
{body}
assert "torch" not in sys.modules
"""


def test_policies_of_a_process_choose_their_threads_on_their_own(toy_artifact: Artifact) -> None:
    body = """
one = open_runtime(artifact, threads=1)
print(count() - before)
several = [open_runtime(artifact, threads=n) for n in (3, 2, 1)]
print(count() - before > 0)
stem = artifact.path / artifact.manifest.pieces["stem"].file
onnxruntime.InferenceSession(str(stem))  # other code may have any session it likes
"""
    assert python(THREADS.format(path=str(toy_artifact.path), body=body)).split() == ["0", "True"]


def test_a_global_pool_of_somebody_else_is_reported(toy_artifact: Artifact) -> None:
    body = """
onnxruntime.set_global_thread_pool_sizes(2, 1)
for threads in (1, 2):
    try:
        open_runtime(artifact, threads=threads)
    except RuntimeUnavailableError as error:
        print(error)
"""
    messages = python(THREADS.format(path=str(toy_artifact.path), body=body)).splitlines()
    assert len(messages) == 2
    assert all("other code of this process has made onnxruntime's global thread pool" in one for one in messages)
