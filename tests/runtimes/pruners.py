"""Artifacts that are calibrated by chance: schedules, and pruners that want other things of other observations."""

from pathlib import Path

import numpy as np

from tests.plans import store_schedules
from ttscompile import Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.ir.program import Program

from .plans import random_correction, random_plan


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


def scheduled(made: Artifact) -> Artifact:
    """With its pruner, and two schedules, of which one reads the rollout cache, and has a correction with jumps."""
    manifest, rng = made.manifest, np.random.default_rng(3)
    evenly = uniform_plan(manifest.steps, len(manifest.groups), 2)
    mixed = random_plan(rng, manifest.steps, manifest.groups, np.ones_like(evenly, np.bool_))
    assert (mixed == Source.ROLLOUT).any()
    plans, corrections = {"evenly": evenly, "mixed": mixed}, {"mixed": random_correction(made, rng)}
    store_schedules(made.path, dict(made.pruner), plans, "evenly", {}, corrections=corrections)
    return load_artifact(made.path)
