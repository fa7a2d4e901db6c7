"""What of a checkpoint goes wrong on a robot without an error: cameras, statistics, instruction, chunk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import torch

from ..core.finding import Finding, Level
from ..core.spec import PolicySpec
from .lerobot_config import ACTION
from .lerobot_examined import PART, REPEAT, examine_lerobot, saved_statistics
from .lerobot_processors import Statistics

_LEAST = 1e-6
"""A range or deviation below this share of its place is none: of a joint that never moved."""


def examine(path: Path, spec: PolicySpec, encoders: str | os.PathLike[str] | None = None) -> list[Finding]:
    """Look at a checkpoint that was loaded.

    Args:
        path: of the checkpoint.
        spec: what loading it gave.
        encoders: folder where the tokenizer is, if it is neither in nor beside the checkpoint.
    """
    judged = [_judged(key, one, spec) for key, one in statistics(path, spec).items()]
    return [*_inputs(spec), *judged, *(examine_lerobot(path, spec, encoders) if _of_lerobot(spec) else [])]


def statistics(path: Path, spec: PolicySpec) -> Mapping[str, Statistics]:
    """What the observations of a checkpoint are normalised by, under the robot's names, and ``action``."""
    if _of_lerobot(spec):
        return saved_statistics(path)
    affine = {key: one.normalizer for key, one in spec.observations.items()} | {ACTION: spec.chunk.normalizer}
    ends = {
        key: [torch.from_numpy((end - one.offset) / one.scale) for end in (-1, 1)]
        for key, one in affine.items()
        if one is not None
    }
    return {key: Statistics("MIN_MAX", low, high, eps=1e-8) for key, (low, high) in ends.items()}


def _of_lerobot(spec: PolicySpec) -> bool:
    return spec.source.get("format") == "lerobot"


def _inputs(spec: PolicySpec) -> list[Finding]:
    """What the policy takes and gives, to be compared with the robot."""
    cameras, others = [], []
    for key, one in spec.observations.items():
        size = f"{one.shape[-1]}x{one.shape[-2]}" + " from any size" * (one.fit is not None) if one.image else ""
        (cameras if size else others).append(f"{key} {size or list(one.shape)}")
    executed = spec.chunk.stop - spec.chunk.start
    chunk = f"{spec.chunk.action_dim} numbers; {executed} of {spec.sample[0]} predicted steps are executed"
    remedy = "The robot waits for a call at every step. Raise n_action_steps."
    return [
        Finding(PART, "cameras", f"{len(cameras)}, in this order: {'; '.join(cameras)}" if cameras else "none"),
        Finding(PART, "other inputs", "; ".join(others) or "none"),
        Finding.judged(PART, ACTION, chunk, executed == 1 < spec.sample[0], remedy),
    ]


def _judged(key: str, one: Statistics, spec: PolicySpec) -> Finding:
    """Whether statistics do what they are for."""
    by_mean = one.mode == "MEAN_STD"
    what, of = f"normaliser of {key}", "deviation" if by_mean else "range"
    first, second = one.first.flatten(), one.second.flatten()
    width = second if by_mean else second - first
    inert = width.abs() <= _LEAST * first.abs().clamp(min=1e-3)
    if (inverted := (width < 0) & ~inert).any():
        told = f"inverted: its {of} is below zero in {_columns(inverted)}"
        return Finding(PART, what, told, Level.PROBLEM, f"Minimum and maximum are exchanged, or damaged. {REPEAT}")
    if inert.all():
        return Finding(PART, what, f"inert: its {of} is 0 everywhere", Level.PROBLEM, REPEAT)
    if inert.any() and key == ACTION:
        return Finding(PART, what, f"the policy always gives the same in {_columns(inert)}", Level.NOTE)
    if inert.any():
        told = f"its {of} is 0 in {_columns(inert)}: another value there becomes millions"
        remedy = "Hold these still, as in training; if the robot moves them, train on data in which they move."
        return Finding(PART, what, told, Level.WARNING, remedy)
    place, size = (0, 1) if by_mean else (-1, 2)
    image = key in spec.observations and spec.observations[key].image
    identity = not image and bool(((first == place) & (width == size)).all())
    told = f"{of} of {len(width)} numbers" + ", which is the identity" * identity
    remedy = f"Was the data of this size already? If not, these statistics are a placeholder. {REPEAT}"
    return Finding.judged(PART, what, told, identity, remedy)


def _columns(which: torch.Tensor) -> str:
    """For people: the first of the columns that are true, and of how many."""
    found = which.nonzero().flatten().tolist()
    return f"column {', '.join(map(str, found[:8]))}{', ..' * (len(found) > 8)} of {len(which)}"
