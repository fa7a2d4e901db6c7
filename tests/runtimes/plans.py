"""Random legal plans."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile import legalize
from ttscompile.artifact import Artifact
from ttscompile.artifact.view import View
from ttscompile.core.correction import HIDDEN, HISTORY, Correction, jumps_of, no_correction
from ttscompile.core.lattice import BoolArray, PlanArray


def random_plan(
    rng: np.random.Generator, steps: int, groups: Sequence[int], written: BoolArray, computed: float = 0.15
) -> PlanArray:
    """A legal plan ``[K, blocks]`` of all sources, of which a share ``computed`` is COMPUTE."""
    rest = rng.dirichlet(np.ones(3)) * (1 - computed)
    plan = rng.choice(4, size=(steps, len(groups)), p=[computed, *rest]).astype(np.int8)
    if rng.random() < 0.5:  # most of a step like the step before, which is what lets sums be shared
        repeat = rng.random(steps) < 0.5
        for k in np.flatnonzero(repeat[1:]) + 1:
            plan[k] = np.where(plan[k - 1] == 0, 2, plan[k - 1])
    return legalize(plan, groups, written)[0]


def random_correction(artifact: Artifact | View, rng: np.random.Generator) -> Correction:
    manifest = artifact.manifest
    groups = artifact.groups if isinstance(artifact, View) else None
    like = no_correction(manifest.steps, manifest.spec.sample, groups)
    scale = 0.3 / np.sqrt(like.weights.shape[2])
    anchors = rng.random(manifest.steps) < 0.5
    if len(anchors) > 2:
        anchors[:3] = True, False, True  # there is a jump, then
    reading = random_reading(rng, manifest.condition_numbers, like)
    return Correction(
        anchors,
        (scale * rng.standard_normal(like.weights.shape)).astype(np.float32),
        (0.1 * rng.standard_normal(like.bias.shape)).astype(np.float32),
        *reading,
        *random_jumps(rng, anchors, manifest.spec.sample, reading[0].shape[1]),
    )


def random_jumps(
    rng: np.random.Generator, anchors: BoolArray, sample: tuple[int, int], read: int
) -> list[npt.NDArray[np.float32]]:
    """The three layers of the jumps between these anchors."""
    count, chunk = len(jumps_of(anchors)), sample[0] * sample[1]
    shapes = ((read + HISTORY * chunk + 1, HIDDEN), (HIDDEN + 1, HIDDEN), (HIDDEN + 1, chunk))
    return [
        (rng.standard_normal((count, *shape)) / np.sqrt(shape[0])).astype(np.float32)
        if count
        else np.zeros((0, 0, 0), np.float32)
        for shape in shapes
    ]


def jumping(anchors: list[bool], read: int = 3, horizon: int = 4) -> Correction:
    """A correction that is zeros but for jumps that read some of seven numbers of the condition."""
    rng = np.random.default_rng(2)
    like = no_correction(len(anchors), (horizon, 2))
    flags = np.array(anchors)
    reading = rng.standard_normal((7, read)).astype(np.float32)
    layers: dict[str, Any] = dict(
        zip(("inner", "middle", "outer"), random_jumps(rng, flags, (horizon, 2), read), strict=True)
    )
    observed = np.zeros((read, *like.observed.shape[1:]), np.float32)
    return replace(like, anchors=flags, reading=reading, observed=observed, **layers)


def random_reading(
    rng: np.random.Generator, numbers: int, like: Correction, read: int = 3
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """What a random correction reads of N numbers of the condition, and what that adds."""
    read = min(read, numbers)
    reading = rng.standard_normal((numbers, read)) / np.sqrt(max(numbers, 1))
    observed = 0.1 * rng.standard_normal((read, *like.observed.shape[1:]))
    return reading.astype(np.float32), observed.astype(np.float32)
