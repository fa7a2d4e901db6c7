"""Which entries of the rollout cache a call of an artifact's plans can read, and what keeping them takes."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from ttscompile.artifact.view import View
from ttscompile.core.lattice import BoolArray, Source
from ttscompile.core.plan import Plan

HEAD = ("pruner.base", "pruner.mask", "pruner.step", "pruner.block")
"""Constants of a pruner whose logits are ``base + mask + (code * step) @ block`` with a code of -1..1."""


@dataclass(frozen=True)
class RolloutNeeds:
    """The rollout cache of one stream.

    Attributes:
        read: entries that schedules and pruner of its plans can read.
        bytes_read: what these take.
        cells: K * blocks, what a plan that the caller gives can read.
        bytes_most: what these take.
    """

    read: int
    bytes_read: int
    cells: int
    bytes_most: int


def rollout_needs(view: View) -> RolloutNeeds:
    """What keeping the rollout cache of one stream takes."""
    entry = 4 * math.prod(view.manifest.blocks[0].type.at(1))  # residuals are float32
    readable = readable_rollout(view)
    read = int(np.count_nonzero(readable))
    return RolloutNeeds(read, read * entry, readable.size, readable.size * entry)


def readable_rollout(view: View) -> BoolArray:
    """Entries that some plan of the view can read, its schedules' and its pruner's: bool ``[K, blocks]``."""
    manifest = view.manifest
    readable = np.zeros((manifest.steps, len(manifest.blocks)), dtype=np.bool_)
    for schedule in view.schedules.values():
        readable |= schedule == Source.ROLLOUT
    if view.pruned:
        readable |= sources_of_pruner(view)[..., Source.ROLLOUT]
    return readable


def reads_earlier_calls(view: View, plan: Plan) -> bool:
    """Whether the cells of a plan can read what an earlier call of the episode computed; ``view`` is the plan's."""
    if plan.cells is None:
        return bool(sources_of_pruner(view)[..., Source.ROLLOUT].any())
    return bool((plan.cells == Source.ROLLOUT).any())


def sources_of_pruner(view: View) -> BoolArray:
    """Sources whose logit can be the largest: bool ``[K, blocks, 4]``; all of a pruner that is not the head we know."""
    shape = (view.manifest.steps, len(view.manifest.blocks), len(Source))
    head, possible = view.pruner, np.ones(shape, dtype=np.bool_)
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
