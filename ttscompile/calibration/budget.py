"""What a plan may cost, in the terms of whoever asks, and the number of computed cells that it comes to.

A latency is measured, with onnxruntime on this machine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..artifact.ceiling import TYPICAL_SPARSITY
from ..artifact.manifest import Manifest
from ..core.coercion import integer
from ..core.lattice import dense_plan, uniform_plan
from ..core.plan import Plan
from ..errors import CalibrationError, CalibrationFailedError
from ..runtimes.open import open_runtime
from ..runtimes.random_calls import normalized, random_call
from ..runtimes.runtime import Runtime
from .judge import TIMED, WARM_UP, timed
from .trials import Trials

SPARSITY, FLOPS, LATENCY, ERROR = "target_sparsity", "target_flops", "latency_ms", "max_action_error"
"""The ways to ask for a plan: the names of the arguments of ``calibrate``."""
DISTANCE = "max_distance"
"""Another one, where the default is chosen among many plans; a latency may go with it."""


@dataclass(frozen=True)
class Goal:
    """What was asked for, and what it comes to.

    Attributes:
        kind: ``target_sparsity``: share of the cells to reuse. ``target_flops``: share of the FLOPs of a dense call of
            the policy as it was to save, prologue and pruner counted. ``latency_ms``: a call with onnxruntime on this
            machine. ``max_action_error``: on held-out episodes, in the units of the actions.
        value: the figure that was asked for, in the unit of its kind.
        threads: how many threads the timed calls have; for ``latency_ms`` alone.
        cells: that a plan may compute, step 0 included; 0 before that is known.
        measured: how it was found out, where it was measured; JSON.
    """

    kind: str
    value: float
    threads: int = 1
    cells: int = 0
    measured: Mapping[str, Any] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """As JSON, for the record and the settings of a state."""
        found = {self.kind: self.value, **({"threads": self.threads} if self.kind == LATENCY else {})}
        return {**found, "cells": self.cells, **self.measured} if self.cells else found

    def sparsity(self, manifest: Manifest) -> float:
        """Share of the cells that a plan has to reuse."""
        return self.value if self.kind == SPARSITY else 1 - self.cells / (manifest.steps * len(manifest.blocks))

    def __str__(self) -> str:
        return f"{self.kind.replace('_', ' ')} {self.value:g}"


def goal_of(
    target_sparsity: float | None = None,
    target_flops: float | None = None,
    latency_ms: float | None = None,
    max_action_error: float | None = None,
    threads: int = 1,
    *,
    usual: float = TYPICAL_SPARSITY,
) -> Goal:
    """The one thing that was asked for; the sparsity ``usual`` if nothing was. Budgets exclude each other."""
    asked = {SPARSITY: target_sparsity, FLOPS: target_flops, LATENCY: latency_ms, ERROR: max_action_error}
    given = {kind: value for kind, value in asked.items() if value is not None}
    if len(given) > 1:
        raise CalibrationError(f"expected one budget; found {' and '.join(given)}. They exclude each other: give one.")
    kind, value = next(iter(given.items()), (SPARSITY, usual))
    threads = integer(threads, "threads", CalibrationError, 1)
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
    """Computed cells of a ``target_sparsity`` or ``target_flops``; ``pruned`` where the pruner may run."""
    steps, blocks, flops = manifest.steps, len(manifest.blocks), manifest.flops
    step = sum(flops.blocks)
    fixed = flops.call(dense_plan(steps, blocks), pruned) - steps * step  # a call without its blocks
    if goal.kind == FLOPS:  # as many whole steps as fit, and cells of average cost
        cells = int(((1 - goal.value) * flops.dense - fixed) / step * blocks + 1e-6)
        most, least = 1 - (fixed + step) / flops.dense, 1 - (fixed + (steps - 1) * step) / flops.dense
        why = (
            "prologue, stems, tails, the pruner and the dense step 0 take"
            f" {1 - most:.4g} of a dense call, so at most {most:.4g} can be saved. Lower the target."
        )
    else:
        cells = int((1 - goal.value) * steps * blocks + 1e-6)
        most, least = 1 - 1 / steps, 1 / steps
        why = (
            f"step 0 of every call is dense, so at most {most:.4g} of the {steps} x {blocks} cells can be reused. Lower"
            " the target, or convert with more denoising steps."
        )
    if cells < blocks:
        raise CalibrationError(f"{goal} cannot be reached: {why}")
    if cells > (steps - 1) * blocks:
        raise CalibrationError(
            f"{goal} leaves {cells} of the {steps} x {blocks} cells to be computed, and less than one whole step to be"
            f" reused: that is the dense policy. Ask for at least {least:.4g}."
        )
    return cells


def measure_budget(trials: Trials, goal: Goal, pruned: bool) -> Goal:
    """The goal with the largest number of computed cells, in whole steps, whose calls fit.

    Bisection over the number of steps, on plans in the precision of the base. Where the pruner may run (``pruned``),
    what the loop waits for it is added. The goal is of kind ``latency_ms``. Refused is one that not even one computed
    step keeps, or all steps do.
    """
    assert goal.kind == LATENCY
    manifest, base = trials.runner.view.manifest, trials.base
    steps, blocks = manifest.steps, len(manifest.blocks)
    runtime = open_runtime(trials.artifact, "onnxruntime", goal.threads, plan=base) if pruned else None
    waited = 0.0 if runtime is None else _pruner_ms(manifest, runtime, base)
    measured: dict[int, float] = {}

    def fits(full: int) -> bool:
        plan = replace(base, cells=uniform_plan(steps, blocks, full))
        measured[full] = waited + timed([(trials, plan)], goal.threads)[0].median
        return measured[full] <= goal.value

    here = f"on this machine with {goal.threads} thread{'s' * (goal.threads > 1)}"
    if not fits(1):
        raise CalibrationFailedError(
            f"{goal} cannot be reached: a call that computes step 0 alone takes {measured[1]:.4g} ms {here}. Allow"
            " more, or convert with fewer denoising steps or --precision int8."
        )
    if fits(steps):
        met = f"{goal} is met by the dense policy, which takes {measured[steps]:.4g} ms {here}"
        raise CalibrationError(f"{met}: ttscompile.load(..., plan='dense').")
    low, high = 1, steps
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    measured_ms = {str(full): round(measured[full], 3) for full in sorted(measured)}
    return replace(goal, cells=low * blocks, measured={"measured_ms": measured_ms})


def _pruner_ms(manifest: Manifest, runtime: Runtime, base: Plan) -> float:
    """For how long the loop waits for the pruner's plan, in milliseconds; whatever the plan is."""
    plan, waits, (obs, noise) = replace(base, cells=None, repair=True), list[float](), random_call(manifest.spec, 0, 0)
    given = normalized(manifest.spec, obs)
    for _ in range(WARM_UP + TIMED):
        waits.append(runtime.predict(given, noise, plan)[1].timings.wait_pruner)
        runtime.reset()
    return float(np.median(waits[WARM_UP:]))
