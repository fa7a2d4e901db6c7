"""What every family has to pass."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from torch import nn

from tests.rounding import Counted, amplified, bound
from tests.runtimes.agreement import call_terms, largest_difference
from ttscompile import PolicySpec
from ttscompile.artifact import load_artifact
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.program import Program
from ttscompile.runtimes import open_runtime

GOLDEN = Path(__file__).parent / "golden"

Arrays = dict[str, np.ndarray]


def golden(name: str) -> Arrays:
    """What the original made; see ``golden/README.md``."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        return dict(file)


def part(arrays: Arrays, name: str) -> Arrays:
    """What is called ``NAME.WHAT`` among arrays, by WHAT."""
    return {key.removeprefix(f"{name}."): value for key, value in arrays.items() if key.startswith(f"{name}.")}


def kinds(program: Program) -> dict[str, int]:
    """How many blocks of each kind were found; a signature without what changes with the version of torch."""
    return dict(Counter(re.sub(r"\d+ops_\w+$", "region", block.kind) for block in program.blocks))


def in_loop(program: Program) -> float:
    """Share of the dense FLOPs that are left in the loop."""
    pieces = program.pieces
    steps = program.spec.sampler.steps
    return sum(graph_flops(piece.graph) for piece in pieces.loop.values()) * steps / program.dense_flops


def assert_runtimes_agree(folder: Path, streams: tuple[int, ...] = (1, 3)) -> None:
    """Random legal plans, one for each stream, give the same samples in both runtimes."""
    artifact = load_artifact(folder)
    left, right = open_runtime(artifact, "onnxruntime"), open_runtime(artifact, "reference")
    rng = np.random.default_rng(0)
    allowed = bound(amplified(call_terms(artifact), artifact.manifest.spec.sampler))
    for count in streams:
        assert largest_difference(artifact, left, right, rng, count, calls=3) < allowed


def rounded(module: nn.Module, conditions: Arrays, spec: PolicySpec) -> tuple[float, float]:
    """Terms and largest angle of a whole call, as ``tests.rounding`` counts them."""
    inputs = {key: torch.from_numpy(value) for key, value in conditions.items()}
    largest = torch.tensor(spec.sampler.timesteps).max().expand(len(next(iter(inputs.values()))))
    with torch.no_grad(), Counted() as counted:
        module(torch.zeros(len(largest), *spec.sample), largest, **inputs)
    return amplified(spec.sampler.steps * counted.terms, spec.sampler), counted.angle
