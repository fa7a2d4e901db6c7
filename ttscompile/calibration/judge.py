"""How good plans are on calls that they were not learned from, and whether that is good enough."""

from __future__ import annotations

from collections.abc import Mapping

from ..artifact.load import Artifact
from ..artifact.manifest import UNIFORM, Manifest
from ..core.lattice import PlanArray, uniform_plan
from ..errors import CalibrationFailedError
from ..runtimes.settle import pruner_plan
from .budget import ERROR, FLOPS, Goal
from .calls import LARGEST, Actions, Calls
from .execute import Executor
from .named import Named
from .result import CalibrationResult, PlanScore
from .strategies import Found

PRUNED, SCHEDULE = "tts", "schedule"
"""Names of plans in the artifact: the pruner's, and the best that does not depend on the observation."""

BASELINE = "interval"
"""The strategy that is no better than the uniform schedule, and need not be."""

BETTER = 0.9
"""A plan has to bring the error below this share of the uniform schedule's."""


def uniform_of(artifact: Artifact, budget: int) -> PlanArray:
    """The baseline: whole steps, evenly spaced; the last cells of the budget are rounded up to one, in its favour."""
    manifest = artifact.manifest
    blocks = len(manifest.blocks)
    return uniform_plan(manifest.steps, blocks, -(-budget // blocks))


def judge(
    artifact: Artifact, executor: Executor, found: Found, named: Named, calls: Calls, budget: int
) -> dict[str, PlanScore]:
    """Scores of the plans that a strategy found, of those beside it, and of the baseline.

    Args:
        artifact: the policy.
        executor: of the policy.
        found: by the strategy.
        named: plans beside the target.
        calls: of episodes that it did not learn from, with targets.
        budget: computed cells.

    Returns:
        By the name of the plan.
    """
    manifest, actions = artifact.manifest, Actions(artifact.manifest.spec)
    scores = {}
    corrected, plain = executor.corrected(found.correction), executor.corrected(None)
    judged = [(SCHEDULE, found.schedule, corrected), (UNIFORM, uniform_of(artifact, budget), plain)]
    judged += [(name, one.plan, executor.corrected(one.correction)) for name, one in named.plans.items()]
    for name, plan, runs in judged:
        errors = actions.errors(runs.run(plan, calls), calls.targets, units=True)
        scores[name] = PlanScore.of(errors, plan[None], manifest.flops, pruned=False)
    if found.pruner is not None:
        plans = pruner_plan(executor.logits(calls, found.pruner))
        errors = actions.errors(corrected.run(plans, calls), calls.targets, units=True)
        scores[PRUNED] = PlanScore.of(errors, plans, manifest.flops, pruned=True)
    return scores


def default_of(scores: Mapping[str, PlanScore], goal: Goal, cells: int, manifest: Manifest) -> str:
    """The pruner's plans if they are no worse than the schedule on held-out calls, and keep the budget as it does.

    Args:
        scores: of all plans.
        goal: what was asked for.
        cells: what it comes to.
        manifest: of the artifact.
    """
    pruned = scores.get(PRUNED)
    if pruned is None or pruned.sparsity < goal.sparsity(cells, manifest) - 1e-9:
        return SCHEDULE
    saves = goal.kind != FLOPS or pruned.flops_saved >= goal.value - 1e-9
    return PRUNED if saves and pruned.error <= scores[SCHEDULE].error else SCHEDULE


def require_success(result: CalibrationResult, goal: Goal) -> None:
    """Raise unless the default plan is what was asked for.

    Args:
        result: of the calibration.
        goal: what was asked for.

    Raises:
        CalibrationFailedError: says which of its promises it breaks.
    """
    chosen, baseline = result.plans[result.default_plan], result.plans[UNIFORM]
    what = f"plan {result.default_plan!r} of strategy {result.strategy!r}"
    if chosen.error > LARGEST / 1e6:  # the mean of some calls, one of which is that far off
        raise CalibrationFailedError(f"the actions of {what} are not numbers. The artifact is as it was.")
    if chosen.sparsity < result.target_sparsity - 1e-9:
        raise CalibrationFailedError(
            f"{what} reaches a sparsity of {chosen.sparsity:.4f} on the validation calls; the target is"
            f" {result.target_sparsity:g}. The artifact is as it was. Calibrate with more episodes or more time."
        )
    if goal.kind == FLOPS and chosen.flops_saved < goal.value - 1e-9:
        raise CalibrationFailedError(
            f"{what} saves {chosen.flops_saved:.4f} of the FLOPs of a dense call; the target is {goal.value:g}: its"
            " blocks cost more than the average. The artifact is as it was. Raise the target a little, or take strategy"
            " 'tts', which computes whole steps."
        )
    if goal.kind == ERROR and not chosen.error <= goal.value:
        raise CalibrationFailedError(
            f"{what} computes {result.budget['cells']} cells, and is {chosen.error:.4g} off on average on the"
            f" validation calls; at most {goal.value:g} was asked for. The artifact is as it was. Allow a larger error,"
            " more time, or calibrate with more episodes."
        )
    if result.strategy != BASELINE and not chosen.error < BETTER * baseline.error:
        raise CalibrationFailedError(
            f"{what} is no better than the uniform schedule: on the validation calls its actions are {chosen.error:.4g}"
            f" off on average, the uniform schedule's {baseline.error:.4g} (expected below {BETTER:.0%} of that). The"
            " artifact is as it was. Calibrate with more episodes or more time, or lower the target."
        )
