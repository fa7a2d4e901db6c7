"""Runs of idle steps in one kernel, against the reference: on a GPU, or in Triton's interpreter on the CPU.

The interpreter needs numpy before 2.5, and has to be asked for before torch imports Triton::

    TRITON_INTERPRET=1 pytest tests/runtimes/test_fused.py
"""

import importlib
import importlib.util
import os
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from tests.rounding import assert_equal_but_for_rounding
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.torch.backend import TorchBackend
from ttscompile.runtimes.torch.sampler import Advance

from .agreement import call_terms, random_inputs
from .conftest import MakeArtifact
from .plans import random_correction, random_jumps
from .toys import random_sampler, toy_program

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed"),
    pytest.mark.skipif(
        DEVICE == "cpu" and os.environ.get("TRITON_INTERPRET") != "1", reason="neither a GPU nor TRITON_INTERPRET=1"
    ),
    pytest.mark.filterwarnings("ignore:Conversion of an array with ndim > 0"),  # Triton's own, in its interpreter
]
STEPS, BLOCKS = 12, 4


@pytest.fixture
def fused() -> ModuleType:
    return importlib.import_module("ttscompile.runtimes.torch.fused")


@pytest.mark.parametrize("streams", [1, 3])
@pytest.mark.parametrize("grouped", [True, False])
@pytest.mark.parametrize(
    ("memories", "clip", "sequence_first", "normed"),
    [(0, None, False, True), (0, 0.3, False, False), (1, 0.3, True, True), (2, None, False, True)],
)
def test_it_agrees_with_the_reference(
    make_artifact: MakeArtifact,
    fused: ModuleType,
    streams: int,
    grouped: bool,
    memories: int,
    clip: float | None,
    sequence_first: bool,
    normed: bool,
) -> None:
    program = toy_program(STEPS, BLOCKS, pruner=False, sequence_first=sequence_first, normed=normed)
    sampler = random_sampler(STEPS, memories, memories, clip)
    artifact = make_artifact(replace(program, spec=replace(program.spec, sampler=sampler)))
    runtime, reference = open_runtime(artifact, "torch", device=DEVICE), open_runtime(artifact, "reference")
    assert isinstance(runtime.backend, TorchBackend)
    idle = runtime.backend._parts.idle
    assert idle is not None
    runs = list[int]()
    idle.fused = Counting(fused, runs)
    terms = call_terms(artifact) + STEPS * 6 * 3
    rng = np.random.default_rng(memories)
    for _ in range(3):
        plan, correction = uniform_plan(STEPS, BLOCKS, 3), random_correction(artifact, rng)
        if not grouped:
            correction = replace(correction, weights=correction.weights[:, :1])
        anchors = (plan == Source.COMPUTE).all(axis=1)  # and no idle step, as in what calibration makes
        jumps = random_jumps(rng, anchors, artifact.manifest.spec.sample, correction.reads)
        named: dict[str, Any] = dict(zip(("inner", "middle", "outer"), jumps, strict=True))
        obs, noise = random_inputs(artifact, rng, streams)
        for own in (None, replace(correction, anchors=anchors, **named)):
            one = Plan(cells=plan, correction=own)
            ours, theirs = (each.predict(obs, noise, one)[0] for each in (runtime, reference))
            assert_equal_but_for_rounding(ours, theirs, terms)
    assert runs and set(runs) == {3}


def test_what_is_not_a_number_stays_so(make_artifact: MakeArtifact, fused: ModuleType) -> None:
    """A sampler that clips must not turn it into a bound."""
    program = toy_program(STEPS, BLOCKS, pruner=False, normed=True)
    artifact = make_artifact(replace(program, spec=replace(program.spec, sampler=random_sampler(STEPS, 0, 0, 0.3))))
    runtime = open_runtime(artifact, "torch", device=DEVICE)
    assert isinstance(runtime.backend, TorchBackend) and runtime.backend._parts.idle is not None
    runtime.backend._parts.idle.fused = fused
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)
    broken = {"obs": np.full_like(obs["obs"], np.nan)}
    assert np.isnan(runtime.predict(broken, noise, Plan(cells=uniform_plan(STEPS, BLOCKS, 2)))[0]).all()


def test_anchors_and_steps_that_are_too_large_are_left_to_torch(make_artifact: MakeArtifact, fused: ModuleType) -> None:
    artifact = make_artifact(toy_program(STEPS, BLOCKS, pruner=False, normed=True))
    advance = Advance(artifact.manifest.spec, None, torch.device(DEVICE))
    advance.anchors[4] = True
    assert fused.fits(advance, 1, 3) and fused.fits(advance, 5, 7)
    assert not fused.fits(advance, 3, 2) and not fused.fits(advance, 1, 1)
    advance.updates = torch.empty(STEPS, 2, 512, 512)  # of two dimensions
    assert not fused.fits(advance, 1, 3)


class Counting:
    """The module, which also writes down how many steps each run has."""

    def __init__(self, module: ModuleType, runs: list[int]) -> None:
        self.fits, self._module, self._runs = module.fits, module, runs

    def run(self, *given: object) -> object:
        self._runs.append(len(given[-1]))  # type: ignore[arg-type]
        return self._module.run(*given)
