"""How many whole steps a call may compute to take no longer than was asked for, with onnxruntime on this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ..artifact.load import Artifact
from ..artifact.manifest import PlanRecord
from ..core.correction import Correction
from ..core.lattice import PlanArray, sparsity, uniform_plan
from ..core.spec import Noise
from ..errors import CalibrationError
from ..measure.timer import Timer
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from ..runtimes.runtime import Runtime
from .budget import LATENCY, Budget, Goal

WARM_UP, FEWEST, MOST, SECONDS = 2, 5, 25, 2.0
"""Calls of a plan that are not counted; that are, at least and at most; and after how long no more are made."""


def with_plans(
    artifact: Artifact, plans: Mapping[str, PlanArray], corrections: Mapping[str, Correction] | None = None
) -> Artifact:
    """The artifact, in memory, with more schedules: a runtime treats them as it does those of the file.

    Args:
        artifact: loaded.
        plans: int8 ``[K, blocks]`` by name.
        corrections: by the name of their plan.
    """
    records = {name: PlanRecord("schedule", sparsity(plan), None) for name, plan in plans.items()}
    return replace(
        artifact,
        manifest=replace(artifact.manifest, plans={**artifact.manifest.plans, **records}),
        schedules={**artifact.schedules, **plans},
        corrections={**artifact.corrections, **(corrections or {})},
    )


def measure_budget(artifact: Artifact, goal: Goal, pruned: bool) -> Budget:
    """The largest number of computed cells, in whole steps, whose calls fit.

    Bisection over the number of steps; each candidate is the median of some calls on one stream. Where the pruner may
    run, what the loop waits for it is added.

    Args:
        artifact: the policy.
        goal: of kind ``latency_ms``.
        pruned: whether the pruner may run.

    Raises:
        CalibrationError: not even a call of one computed step fits, or a dense one does.
    """
    assert goal.kind == LATENCY
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)
    names = {full: f"{full} steps" for full in range(1, steps + 1)}
    plans = {name: uniform_plan(steps, blocks, full) for full, name in names.items()}
    whole = with_plans(artifact, plans)
    runtime = open_runtime(whole, "onnxruntime", goal.threads)
    policy = CompiledPolicy(whole, runtime, seed=0)
    obs = {key: np.zeros((1, *one.shape), one.dtype) for key, one in artifact.manifest.spec.observations.items()}
    waited = _pruner_ms(artifact, runtime) if pruned else 0.0
    measured: dict[int, float] = {}

    def fits(full: int) -> bool:
        measured[full] = waited + median_ms(lambda: policy.predict_action(obs, plan=names[full]))
        return measured[full] <= goal.value

    if not fits(1):
        raise CalibrationError(
            f"latency ms {goal.value:g} cannot be reached: a call that computes step 0 alone takes {measured[1]:.4g} ms"
            f" on this machine with {goal.threads} thread{'s' * (goal.threads > 1)}. Allow more, or convert with fewer"
            " denoising steps or --precision int8."
        )
    if fits(steps):
        raise CalibrationError(
            f"latency ms {goal.value:g} is met by the dense policy, which takes {measured[steps]:.4g} ms on this"
            f" machine with {goal.threads} thread{'s' * (goal.threads > 1)}: ttscompile.load(..., plan='dense')."
        )
    low, high = 1, steps
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return Budget(
        goal, low * blocks, {"measured_ms": {str(full): round(measured[full], 3) for full in sorted(measured)}}
    )


def median_ms(call: Callable[[], object]) -> float:
    """Median wall time of a call, in milliseconds."""
    timer = Timer(1, WARM_UP)
    while timer.counted < FEWEST or (timer.counted < MOST and timer.seconds < SECONDS):
        timer.round()
        timer.time(0, call)
    return timer.times[0].median


def _pruner_ms(artifact: Artifact, runtime: Runtime) -> float:
    """For how long the loop waits for the pruner's plan, in milliseconds; whatever the plan is."""
    spec = artifact.manifest.spec
    obs = {
        key: np.zeros((1, *one.shape), one.dtype if one.normalizer is None else np.float32)
        for key, one in spec.observations.items()
    }
    noise = Noise(np.zeros((1, *spec.sample), np.float32), np.zeros((spec.sampler.steps, 1, *spec.sample), np.float32))
    waits = []
    for _ in range(WARM_UP + FEWEST):
        _, report = runtime.predict(obs, noise)
        runtime.reset()
        waits.append(report.timings.wait_pruner)
    return float(np.median(waits[WARM_UP:]))
