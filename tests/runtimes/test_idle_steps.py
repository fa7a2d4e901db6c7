"""Steps without a computed block, in numpy, against the reference: every sampler, any plan, any number of streams."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Source
from ttscompile.artifact import Artifact
from ttscompile.core.lattice import legalize, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.ir.graph import Node, Ref
from ttscompile.ir.pieces import IDLE
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.idle_steps import IdleSteps

from .agreement import assert_alike, call_terms, random_inputs
from .conftest import MakeArtifact
from .plans import random_correction
from .toys import random_sampler, toy_program

STEPS, BLOCKS = 12, 4


def random_plans(rng: np.random.Generator, artifact: Artifact, streams: int, written: np.ndarray) -> np.ndarray:
    """Most steps idle, alone or many in a row, the last among them or not; of all sources; some whole steps."""
    manifest = artifact.manifest
    shape = (streams, manifest.steps, len(manifest.groups))
    plans = rng.choice([1, 2, 3] if rng.random() < 0.5 else [2], size=shape).astype(np.int8)
    repeat = rng.random(manifest.steps) < 0.7  # like the step before
    for k in np.flatnonzero(repeat[1:]) + 1:
        plans[:, k] = plans[:, k - 1]
    plans[:, rng.random(manifest.steps) < 0.15] = Source.COMPUTE
    plans[rng.random(shape) < rng.choice([0.0, 0.02])] = Source.COMPUTE
    if rng.random() < 0.6:
        plans[:] = plans[:1]
    return legalize(plans, manifest.groups, written)[0]


@pytest.mark.slow
@pytest.mark.parametrize("streams", [1, 3])
@pytest.mark.parametrize(
    ("memories", "clip", "sequence_first", "steps"),
    [(0, None, False, 12), (0, 0.3, False, 12), (1, 0.3, True, 12), (2, None, False, 12), (0, 0.3, False, 2)],
)
def test_idle_steps_agree_with_the_reference(
    make_artifact: MakeArtifact, streams: int, memories: int, clip: float | None, sequence_first: bool, steps: int
) -> None:
    program = toy_program(steps, BLOCKS, pruner=False, sequence_first=sequence_first, normed=True)
    sampler = random_sampler(steps, memories, memories, clip)
    artifact = make_artifact(replace(program, spec=replace(program.spec, sampler=sampler)))
    assert IDLE in artifact.manifest.pieces
    runtime, reference = (open_runtime(artifact, name) for name in ("onnxruntime", "reference"))
    terms = call_terms(artifact) + steps * 6 * 3  # a correction adds six numbers for each action of the chunk
    for seed in range(6):
        rng = np.random.default_rng(seed)
        written = np.zeros((streams, steps, BLOCKS), np.bool_)
        for _ in range(3):
            plans = random_plans(rng, artifact, streams, written)
            obs, noise = random_inputs(artifact, rng, streams)
            correction = random_correction(artifact, rng) if rng.random() < 0.7 else None
            ours, theirs = (
                r.predict(obs, noise, Plan(cells=plans, correction=correction))[0] for r in (runtime, reference)
            )
            assert_equal_but_for_rounding(ours, theirs, terms)
            written |= plans == Source.COMPUTE
        runtime.reset()
        reference.reset()


def test_runs_of_idle_steps_go_through_numpy_and_prepare_once(
    make_artifact: MakeArtifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps 1..4 and 7..11 of five that add the same, even with an anchor among them; a run of two does not."""
    artifact = make_artifact(toy_program(STEPS, BLOCKS, pruner=False, normed=True))
    runtime = open_runtime(artifact)
    plan = np.full((STEPS, BLOCKS), Source.TIMESTEP, np.int8)
    plan[[0, 4, 7]] = Source.COMPUTE
    runs: list[tuple[int, int]] = []
    prepared: list[int] = []
    real, prepare = IdleSteps.run, IdleSteps.prepare

    def run(self: IdleSteps, first: int, stop: int, *rest: object) -> None:
        runs.append((first, stop))
        real(self, first, stop, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(IdleSteps, "run", run)
    monkeypatch.setattr(IdleSteps, "prepare", lambda self: prepared.append(1) or prepare(self))  # type: ignore[func-returns-value]
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)
    correction = random_correction(artifact, np.random.default_rng(1))
    without: dict[str, Any] = dict.fromkeys(("inner", "middle", "outer"), np.zeros((0, 0, 0), np.float32))
    runtime.predict(
        obs, noise, Plan(cells=plan, correction=replace(correction, anchors=np.ones(STEPS, np.bool_), **without))
    )
    assert (runs, len(prepared)) == ([(1, 4), (8, 12)], 2)


@pytest.mark.slow
def test_a_network_of_another_form_has_no_such_steps(make_artifact: MakeArtifact) -> None:
    """Its prediction is not affine in the stream."""
    program = toy_program()
    tail = program.pieces.tail
    (out,) = tail.graph.outputs
    bent = Node("bent", "aten.tanh.default", (Ref(out),), (), (tail.graph.types()[out],))
    graph = replace(tail.graph, nodes=(*tail.graph.nodes, bent), outputs=("bent",))
    pieces = replace(program.pieces, tail=replace(tail, graph=graph))
    toy_artifact = make_artifact(replace(program, pieces=pieces))
    assert IDLE not in toy_artifact.manifest.pieces
    runtime = open_runtime(toy_artifact)
    assert isinstance(runtime.backend, OnnxBackend)
    assert runtime.backend.workspace is not None
    assert runtime.backend.workspace.idle is None
    both = runtime, open_runtime(toy_artifact, "reference")
    assert_alike(toy_artifact, both, Plan(cells=uniform_plan(5, 5, 1)), np.random.default_rng(0))
