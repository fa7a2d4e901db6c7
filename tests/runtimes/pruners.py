"""Artifacts whose pruner wants other things of other observations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.plans import store_schedules
from ttscompile.artifact import load_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.ir.program import Program

from .plans import random_correction


def random_pruner(program: Program, seed: int) -> dict[str, np.ndarray]:
    """Weights of a head that wants anything anywhere, a reuse in step 0 too, and other things of other observations."""
    rng = np.random.default_rng(seed)
    head = program.pieces.pruner
    assert head is not None
    weights = {name: rng.standard_normal(type_.at(1)).astype(np.float32) for name, type_ in head.constants.items()}
    return weights | {"pruner.mask": np.zeros_like(weights["pruner.mask"])}


def calibrated(folder: Path, program: Program, corrected: bool = True) -> Path:
    """The artifact with another pruner than it was converted with, which has a correction with jumps."""
    artifact, shape = load_artifact(folder), (program.spec.sampler.steps, len(program.blocks))
    corrections = {"pruner": random_correction(artifact, np.random.default_rng(1))} if corrected else {}
    schedules = {"evenly": uniform_plan(*shape, 2)}
    store_schedules(folder, random_pruner(program, 2), schedules, "pruner", {}, corrections=corrections)
    return folder
