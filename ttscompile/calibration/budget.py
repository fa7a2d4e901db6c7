"""What a plan may cost, in the terms of whoever asks, and the number of computed cells that it comes to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..artifact.ceiling import TYPICAL_SPARSITY
from ..artifact.manifest import Manifest
from ..core.lattice import dense_plan
from ..errors import CalibrationError

SPARSITY, FLOPS, LATENCY, ERROR = "target_sparsity", "target_flops", "latency_ms", "max_action_error"
"""The ways to ask for a plan: the names of the arguments of ``calibrate``."""


@dataclass(frozen=True)
class Goal:
    """What was asked for.

    Attributes:
        kind: ``target_sparsity``: share of the cells to reuse. ``target_flops``: share of the FLOPs of a dense call of
            the policy as it was to save, prologue and pruner counted. ``latency_ms``: a call with onnxruntime on this
            machine. ``max_action_error``: on held-out episodes, in the units of the actions.
        value: the figure that was asked for, in the unit of its kind.
        threads: how many threads the timed calls have; for ``latency_ms`` alone.
    """

    kind: str
    value: float
    threads: int = 1

    def record(self) -> dict[str, Any]:
        """As JSON, for the record and the settings of a state."""
        return {self.kind: self.value, **({"threads": self.threads} if self.kind == LATENCY else {})}

    def sparsity(self, cells: int, manifest: Manifest) -> float:
        """Share of the cells that a plan has to reuse, given how many it may compute."""
        return self.value if self.kind == SPARSITY else 1 - cells / (manifest.steps * len(manifest.blocks))

    def __str__(self) -> str:
        return f"{self.kind.replace('_', ' ')} {self.value:g}"


@dataclass(frozen=True)
class Budget:
    """A goal, and what it comes to.

    Attributes:
        goal: what was asked for.
        cells: that a plan may compute, step 0 included.
        measured: how it was found out, where it was measured; JSON.
    """

    goal: Goal
    cells: int
    measured: Mapping[str, Any] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """As JSON, for the record."""
        return {**self.goal.record(), "cells": self.cells, **self.measured}


def goal_of(
    target_sparsity: float | None = None,
    target_flops: float | None = None,
    latency_ms: float | None = None,
    max_action_error: float | None = None,
    threads: int = 1,
    *,
    usual: float = TYPICAL_SPARSITY,
) -> Goal:
    """The one thing that was asked for; the sparsity ``usual`` if nothing was.

    Raises:
        CalibrationError: more than one, or a value that nothing can have.
    """
    asked = {SPARSITY: target_sparsity, FLOPS: target_flops, LATENCY: latency_ms, ERROR: max_action_error}
    given = {kind: value for kind, value in asked.items() if value is not None}
    if len(given) > 1:
        raise CalibrationError(f"expected one budget; found {' and '.join(given)}. They exclude each other: give one.")
    kind, value = next(iter(given.items()), (SPARSITY, usual))
    if not isinstance(threads, int) or isinstance(threads, bool) or threads < 1:
        raise CalibrationError(f"threads: expected an integer of at least 1; found {threads!r}.")
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    share = kind in (SPARSITY, FLOPS)
    if number and share and value == 0:
        raise CalibrationError(
            f"{kind} 0 asks for the dense policy, which every artifact has: ttscompile.load(..., plan='dense')."
        )
    if not number or not value > 0 or (share and not value < 1):
        expected = "above 0 and below 1" if share else "above 0"
        raise CalibrationError(f"{kind}: expected a number {expected}; found {value!r}.")
    return Goal(kind, float(value), threads)


def cells_of(goal: Goal, manifest: Manifest, pruned: bool) -> int:
    """Computed cells of a goal that can be worked out: ``target_sparsity`` or ``target_flops``.

    Args:
        goal: one of the two.
        manifest: the manifest of the artifact.
        pruned: whether the pruner may run.

    Raises:
        CalibrationError: no plan, or only the dense one, is what was asked for.
    """
    steps, blocks = manifest.steps, len(manifest.blocks)
    cells = _cells_of_flops(goal, manifest, pruned) if goal.kind == FLOPS else _cells_of_sparsity(goal, steps, blocks)
    if cells > (steps - 1) * blocks:
        raise CalibrationError(
            f"{goal} leaves {cells} of the {steps} x {blocks} cells to be computed, and less than one whole step to be"
            f" reused: that is the dense policy. Ask for at least {_least(goal, manifest, pruned):.4g}."
        )
    return cells


def _cells_of_sparsity(goal: Goal, steps: int, blocks: int) -> int:
    cells = int((1 - goal.value) * steps * blocks + 1e-6)
    if cells < blocks:
        raise CalibrationError(
            f"target sparsity {goal.value:g} cannot be reached: step 0 of every call is dense, so at most"
            f" {1 - 1 / steps:.4g} of the {steps} x {blocks} cells can be reused. Lower the target, or convert with"
            " more denoising steps."
        )
    return cells


def _cells_of_flops(goal: Goal, manifest: Manifest, pruned: bool) -> int:
    """As many whole steps as fit, and cells of average cost."""
    flops, blocks = manifest.flops, len(manifest.blocks)
    fixed, step = _fixed(manifest, pruned), sum(flops.blocks)
    cells = int(((1 - goal.value) * flops.dense - fixed) / step * blocks + 1e-6)
    if cells < blocks:
        raise CalibrationError(
            f"target flops {goal.value:g} cannot be reached: prologue, stems, tails, the pruner and the dense step 0"
            f" take {(fixed + step) / flops.dense:.4g} of a dense call, so at most"
            f" {1 - (fixed + step) / flops.dense:.4g} can be saved. Lower the target."
        )
    return cells


def _fixed(manifest: Manifest, pruned: bool) -> float:
    """FLOPs of a call without its blocks."""
    plan = dense_plan(manifest.steps, len(manifest.blocks))
    return manifest.flops.call(plan, pruned) - manifest.steps * sum(manifest.flops.blocks)


def _least(goal: Goal, manifest: Manifest, pruned: bool) -> float:
    """The lowest value of a goal that leaves a whole step to be reused."""
    if goal.kind == SPARSITY:
        return 1 / manifest.steps
    most = _fixed(manifest, pruned) + (manifest.steps - 1) * sum(manifest.flops.blocks)
    return 1 - most / manifest.flops.dense
