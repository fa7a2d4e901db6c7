"""What of a checkpoint goes wrong on a robot without an error: cameras, chunk, and statistics if no family looks."""

import os
from pathlib import Path

import numpy as np
import torch

from ..core.finding import Finding, Level
from ..core.spec import PolicySpec
from .families import function_of

PART, ACTION = "checkpoint", "action"
REPEAT = "Compute the statistics again on the data that the policy was trained with, and save it with them."
_LEAST = 1e-6
"""A range or deviation below this share of its place is none: of a joint that never moved."""


def examine(path: Path, spec: PolicySpec, encoders: str | os.PathLike[str] | None = None) -> list[Finding]:
    """Look at a checkpoint that was loaded with this specification; see ``convert`` for ``encoders``."""
    cameras = [f"{key} {list(one.shape)}" for key, one in spec.observations.items() if one.image]
    others = [f"{key} {list(one.shape)}" for key, one in spec.observations.items() if not one.image]
    executed = spec.chunk.executes
    chunk = f"{spec.chunk.action_dim} numbers; {executed} of {spec.sample[0]} predicted steps are executed"
    found = [
        Finding(PART, "cameras", f"{len(cameras)}, in this order: {', '.join(cameras) or 'none'}"),
        Finding(PART, "other inputs", ", ".join(others) or "none"),
        Finding.judged(PART, ACTION, chunk, executed == 1 < spec.sample[0], "Raise n_action_steps: it calls at each."),
    ]
    own = function_of(spec, "examine")
    if own is not None:
        return [*found, *own(path, spec, encoders)]
    affine = {key: one.normalizer for key, one in spec.observations.items()} | {ACTION: spec.chunk.normalizer}
    both = np.array([[[-1]], [[1]]], np.float32)
    ends = {key: torch.from_numpy(one.unnormalize(both)) for key, one in affine.items() if one is not None}
    return found + [judged(key, low, high) for key, (low, high) in ends.items()]


def judged(
    key: str, first: torch.Tensor, second: torch.Tensor, deviations: bool = False, unseen: bool = False
) -> Finding:
    """Look at the normaliser of one feature: the ends of its numbers' ranges, or their means and standard deviations.

    A number without a range may be ``unseen``: not shown to the policy.
    """
    # Of a chunk's steps the last, whose actions are the furthest from the state that they are relative to.
    first, second = (each[-1] if each.ndim == 2 else each.flatten() for each in (first, second))
    (of, width, place, size) = ("range", second - first, -1, 2)
    if deviations:
        (of, width, place, size) = ("deviation", second, 0, 1)
    inert = width.abs() <= _LEAST * first.abs().clamp(min=1e-3)
    level, told, remedy = Level.OK, f"{of} of {len(width)} numbers", ""
    if (inverted := (width < 0) & ~inert).any():
        level, told = Level.PROBLEM, f"inverted: its {of} is below zero in {_columns(inverted)}"
        remedy = f"Minimum and maximum are exchanged, or damaged. {REPEAT}"
    elif inert.all():
        level, told, remedy = Level.PROBLEM, f"inert: its {of} is 0 everywhere", REPEAT
    elif inert.any() and unseen and key != ACTION:
        level, told = Level.NOTE, f"its range is 0 in {_columns(inert)}, which the policy does not see"
    elif inert.any() and key == ACTION:
        level, told = Level.NOTE, f"the policy always gives the same in {_columns(inert)}"
    elif inert.any():
        level, told = Level.WARNING, f"its {of} is 0 in {_columns(inert)}: another value there becomes millions"
        remedy = "Hold these still, as in training; if the robot moves them, train on data in which they move."
    elif ((first == place) & (width == size)).all():
        level, told = Level.WARNING, f"the identity, for {told}"
        remedy = f"Was the data of this size already? If not, these statistics are a placeholder. {REPEAT}"
    return Finding(PART, f"normaliser of {key}", told, level, remedy)


def _columns(which: torch.Tensor) -> str:
    found = which.nonzero().flatten().tolist()
    return f"column {', '.join(map(str, found[:8]))}{', ..' * (len(found) > 8)} of {len(which)}"
