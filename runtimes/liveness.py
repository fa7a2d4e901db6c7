"""Which entries of the rollout cache a call of an artifact's plans can read, and what keeping them takes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.core.lattice import BoolArray, Source

HEAD = ("pruner.base", "pruner.mask", "pruner.step", "pruner.block")
"""Constants of a pruner whose logits are ``base + mask + (code * step) @ block`` with a code of -1..1."""


@dataclass(frozen=True)
class RolloutNeeds:
    """The rollout cache of one stream.

    Attributes:
        read: entries that the artifact's schedules and pruner can read.
        bytes_read: what these take.
        cells: K * blocks, what a plan that the caller gives can read.
        bytes_most: what these take.
    """

    read: int
    bytes_read: int
    cells: int
    bytes_most: int


def rollout_needs(artifact: Artifact) -> RolloutNeeds:
    """What keeping the rollout cache of one stream takes."""
    entry = 4 * math.prod(artifact.manifest.blocks[0].type.at(1))  # residuals are float32
    readable = readable_rollout(artifact)
    read = int(np.count_nonzero(readable))
    return RolloutNeeds(read, read * entry, readable.size, readable.size * entry)


def readable_rollout(artifact: Artifact) -> BoolArray:
    """Entries that some plan of the artifact can read, its schedules' and its pruner's: bool ``[K, blocks]``."""
    manifest = artifact.manifest
    readable = np.zeros((manifest.steps, len(manifest.blocks)), dtype=np.bool_)
    for schedule in artifact.schedules.values():
        readable |= schedule == Source.ROLLOUT
    if any(plan.pruned for plan in manifest.plans.values()):
        readable |= sources_of_pruner(artifact)[..., Source.ROLLOUT]
    return readable


def reading_earlier_calls(artifact: Artifact) -> set[str]:
    """Names of the plans that can read what an earlier call of the episode computed."""
    reading = {name for name, schedule in artifact.schedules.items() if (schedule == Source.ROLLOUT).any()}
    pruned = {name for name, plan in artifact.manifest.plans.items() if plan.pruned}
    return reading | pruned if pruned and sources_of_pruner(artifact)[..., Source.ROLLOUT].any() else reading


def sources_of_pruner(artifact: Artifact) -> BoolArray:
    """Sources whose logit can be the largest: bool ``[K, blocks, 4]``; all of a pruner that is not the head we know."""
    shape = (artifact.manifest.steps, len(artifact.manifest.blocks), len(Source))
    head, possible = artifact.pruner, np.ones(shape, dtype=np.bool_)
    if not set(HEAD) <= set(head) or head["pruner.base"].shape != shape:
        return possible
    fixed = head["pruner.base"].astype(np.float64) + head["pruner.mask"]
    by_step = np.abs(head["pruner.step"].astype(np.float64))
    by_cell = head["pruner.block"].astype(np.float64).reshape(by_step.shape[1], *shape[1:])
    for source, other in itertools.permutations(Source, 2):
        lead = fixed[..., source] - fixed[..., other]
        swing = by_step @ np.abs(by_cell[..., source] - by_cell[..., other])
        possible[..., source] &= lead + swing >= -1e-4 * (1 + np.abs(lead) + swing)  # it computes in float32
    return possible
