"""How good plans are on calls that they were not learned from, and whether that is good enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ..artifact.load import Artifact
from ..artifact.manifest import DENSE, UNIFORM, Manifest
from ..core.correction import Correction
from ..core.lattice import PlanArray, uniform_plan
from ..core.spec import FP32
from ..errors import CalibrationFailedError
from ..ir.pieces import PRUNER
from ..runtimes.against_fp32 import FEW_CALLS, answers, mean_errors
from ..runtimes.open import open_runtime
from ..runtimes.random_calls import normalized, random_noise
from ..runtimes.settle import pruner_plan
from ..trajectories.episodes import Episode
from .budget import ERROR, FLOPS, Goal
from .calls import LARGEST, Actions, Calls, FloatArray, draw_noise, sample_calls
from .execute import Executor
from .result import CalibrationResult, PlanScore
from .strategies import FITTED, strategy_of
from .targets import dense_rounds
from .task import Found

SCHEDULE = "schedule"
"""Name in the artifact of the best plan that does not depend on the observation."""

BETTER = 0.9
"""A plan has to bring the error below this share of the uniform schedule's."""

WITH_OTHER_NOISE = 32
"""Held-out calls at most that the dense policy answers a second time."""

IN_PRECISION = 8
"""Calls in the artifact's precision; on Push-T at K = 100 about one second each, the dense ones for the most part."""


def uniform_of(manifest: Manifest, budget: int) -> Found:
    """The baseline: whole steps, evenly spaced; the last cells of the budget are rounded up to one, in its favour."""
    blocks = len(manifest.blocks)
    return Found(uniform_plan(manifest.steps, blocks, -(-budget // blocks)))


def judge(artifact: Artifact, executor: Executor, plans: Mapping[str, Found], calls: Calls) -> dict[str, PlanScore]:
    """Scores of plans, and of those of the pruner that belongs to the one that is called ``schedule``, by name.

    ``calls`` are of episodes that nothing was learned from, with targets; windows of consecutive ones if a plan may
    read what an earlier call computed.
    """
    flops, actions = artifact.manifest.flops, Actions(artifact.manifest.spec)

    def errors(correction: Correction | None, plan: PlanArray) -> FloatArray:
        return actions.errors(executor.corrected(correction).run(plan, calls), calls.targets, units=True)

    scores = dict[str, PlanScore]()
    for name, one in plans.items():
        off, own = errors(one.correction, one.schedule), one.schedule[None]
        scores[name] = PlanScore.of(off, own, flops, pruned=False, correction=one.correction)
    found = plans[SCHEDULE]
    if found.pruner is not None:
        made = pruner_plan(executor.logits(calls, found.pruner))
        shared = found.pruner_correction
        scores[PRUNER] = PlanScore.of(errors(shared, made), made, flops, pruned=True, correction=shared)
    return scores


def dense_with_other_noise(artifact: Artifact, executor: Executor, calls: Calls, seed: int) -> float:
    """How far two answers of the dense policy to one observation are apart, in the units of the actions.

    The yardstick for the errors of plans: what is far below it changes less than the policy's own noise does.

    Args:
        artifact: the artifact of the policy.
        executor: of the artifact.
        calls: with targets; some of them get another noise.
        seed: of that noise.
    """
    spec = artifact.manifest.spec
    some = executor.select(calls, np.arange(min(WITH_OTHER_NOISE, calls.count)))
    initial, noise = draw_noise(spec, some.count, (seed, 5))
    paths = torch.cat(list(dense_rounds(executor, replace(some, initial=initial, noise=noise, path=None))))
    return float(Actions(spec).errors(paths[:, -1], some.targets, units=True).mean())


def default_of(scores: Mapping[str, PlanScore], goal: Goal, cells: int, manifest: Manifest) -> str:
    """The pruner's plans if they are no worse than the schedule on held-out calls, and keep the budget as it does.

    ``cells`` is how many computed cells the goal comes to.
    """
    pruned = scores.get(PRUNER)
    if pruned is None or pruned.sparsity < goal.sparsity(cells, manifest) - 1e-9:
        return SCHEDULE
    saves = goal.kind != FLOPS or pruned.flops_saved >= goal.value - 1e-9
    return PRUNER if saves and pruned.error <= scores[SCHEDULE].error else SCHEDULE


def precision_record(
    artifact: Artifact, episodes: Sequence[Episode], numbers: Sequence[int], schedule: Found, seed: int
) -> dict[str, Any]:
    """Actions in the artifact's precision against those in fp32 with the same plan and noise.

    So this is the error of the precision alone; that of the plan is measured in fp32, and has its own figures.

    Args:
        artifact: the artifact of the policy.
        episodes: all recorded episodes.
        numbers: the numbers of the held-out episodes.
        schedule: what is measured beside ``dense``; it reads nothing of earlier calls, which these calls do not have.
        seed: the seed of the choice of calls and of their noise.

    Returns:
        ``{"precision": {"name": .., "calls": .., "plans": {plan: {"error": .., "error_p90": ..}}, "parts": {part:
        error}}}`` for the calibration record, in the units of the actions; empty for an artifact in fp32. ``parts`` has
        the mean error of dense calls with each part alone in the precision, on some of the calls where there are more.
    """
    precision, spec = artifact.manifest.precision, artifact.manifest.spec
    if precision is None:
        return {}
    draw, calls = np.random.default_rng((seed, 3)), []
    for number, row in sample_calls(episodes, numbers, IN_PRECISION, seed):
        obs = {key: episodes[number].observations[key][row : row + 1] for key in spec.observations}
        calls.append((normalized(spec, obs), random_noise(spec, draw)))
    plain, exact, scores = open_runtime(artifact.at_precision(FP32)), dict[str, list[FloatArray]](), {}
    plans = {DENSE: Found(artifact.schedule(DENSE)), SCHEDULE: schedule}
    for name, one in plans.items():
        exact[name] = answers(plain, one.schedule, calls, one.correction)
    own = open_runtime(artifact)
    for name, one in plans.items():
        errors = mean_errors(spec.chunk, answers(own, one.schedule, calls, one.correction), exact[name])
        scores[name] = {"error": float(errors.mean()), "error_p90": float(np.quantile(errors, 0.9))}
    parts = dict.fromkeys(precision.kept, scores[DENSE]["error"])
    for part in parts if len(parts) > 1 else ():
        alone = answers(open_runtime(artifact.with_parts([part])), plans[DENSE].schedule, calls[:FEW_CALLS])
        parts[part] = float(mean_errors(spec.chunk, alone, exact[DENSE][:FEW_CALLS]).mean())
    return {"precision": {"name": precision.name, "calls": len(calls), "plans": scores, "parts": parts}}


def require_success(result: CalibrationResult, goal: Goal) -> None:
    """Raise unless the default plan is what was asked for.

    Raises:
        CalibrationFailedError: says which of its promises it breaks.
    """
    chosen, baseline = result.plans[result.default_plan], result.plans[UNIFORM]

    def require(kept: bool, what: str, otherwise: str = "") -> None:
        if not kept:
            plan = f"plan {result.default_plan!r} of strategy {result.strategy!r}"
            raise CalibrationFailedError(f"{plan} {what}. The artifact is as it was.{otherwise}")

    # The mean of some calls, one of which is that far off.
    require(chosen.error <= LARGEST / 1e6, "gives actions that are not numbers")
    require(
        chosen.sparsity >= result.target_sparsity - 1e-9,
        f"reaches a sparsity of {chosen.sparsity:.4f} on validation calls; the target is {result.target_sparsity:g}",
        " Calibrate with more episodes or more time.",
    )
    require(
        goal.kind != FLOPS or chosen.flops_saved >= goal.value - 1e-9,
        f"saves {chosen.flops_saved:.4f} of the FLOPs of a dense call; the target is {goal.value:g}: its blocks cost"
        " more than the average",
        f" Raise the target a little, or take strategy {' or '.join(map(repr, FITTED))}, which computes whole steps.",
    )
    require(
        goal.kind != ERROR or chosen.error <= goal.value,
        f"computes {result.budget['cells']} cells, and is {chosen.error:.4g} off on average on the validation calls; at"
        f" most {goal.value:g} was asked for",
        " Allow a larger error, more time, or calibrate with more episodes.",
    )
    require(
        strategy_of(result.strategy).baseline or chosen.error < BETTER * baseline.error,
        f"is no better than the uniform schedule: on the validation calls its actions are {chosen.error:.4g} off on"
        f" average, the uniform schedule's {baseline.error:.4g} (expected below {BETTER:.0%} of that)",
        " Calibrate with more episodes or more time, or lower the target.",
    )
