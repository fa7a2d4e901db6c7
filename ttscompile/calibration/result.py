"""What a calibration achieved, on episodes that it did not learn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..artifact.manifest import FlopsRecord
from ..core.correction import Correction
from ..core.lattice import PlanArray, plan_flops, sparsity
from .calls import FloatArray


@dataclass(frozen=True)
class PlanScore:
    """One plan on the validation calls.

    Attributes:
        error: mean absolute difference between its executed actions and those of the dense policy with the same
            noise, in the units of the actions.
        error_p90: 90th percentile over the calls.
        sparsity: share of the cells that are reused, mean over the calls.
        flops_sparsity: the same with each cell weighed by its FLOPs.
        flops_saved: share of the FLOPs of a dense call of the policy as it was that are saved; prologue, stem, tail and
            (where it runs) pruner are counted.
    """

    error: float
    error_p90: float
    sparsity: float
    flops_sparsity: float
    flops_saved: float

    @classmethod
    def of(
        cls,
        errors: FloatArray,
        plans: PlanArray,
        flops: FlopsRecord,
        pruned: bool,
        correction: Correction | None,
    ) -> PlanScore:
        """Make a score of the error of each call and its plan.

        Args:
            errors: ``[N]``.
            plans: ``[N, K, blocks]``, or ``[1, K, blocks]`` for all calls.
            flops: the FLOPs of the policy's parts.
            pruned: whether the pruner makes the plan.
            correction: of the plan, or of all that the pruner makes; None for none.
        """
        total = plans.shape[1] * sum(flops.blocks)
        return cls(
            error=float(errors.mean()),
            error_p90=float(np.quantile(errors, 0.9)),
            sparsity=sparsity(plans),
            flops_sparsity=1 - float(np.mean([plan_flops(plan, flops.blocks) for plan in plans])) / total,
            flops_saved=1 - float(np.mean([flops.call(plan, pruned, correction) for plan in plans])) / flops.dense,
        )


@dataclass(frozen=True)
class CalibrationResult:
    """The outcome of a calibration.

    Attributes:
        strategy: how the plan was found.
        seed: the seed of everything random.
        target_sparsity: what was asked for, or what the budget comes to.
        default_plan: the plan that the artifact now uses; a key of ``plans``.
        plans: every plan that was judged, by name; ``uniform`` is the baseline that computes as much.
        episodes: numbers of the episodes in the order of the files, learned from and judged on.
        calls: how many calls of these were used.
        intervals: how many intervals the search took.
        stopped: why it ended: ``finished`` or ``time limit``.
        seconds: of work, the parts before an interruption included.
        other_noise: mean absolute difference of the executed actions of two dense calls on one observation with
            different noise, in the units of the actions; None if it was not measured.
        budget: what was asked for, the cells that it comes to, and what was measured for it; JSON.
        skipped: why there is no plan of a name that there might be.
    """

    strategy: str
    seed: int
    target_sparsity: float
    default_plan: str
    plans: Mapping[str, PlanScore]
    episodes: Mapping[str, tuple[int, ...]]
    calls: Mapping[str, int]
    intervals: int
    stopped: str
    seconds: float
    other_noise: float | None = None
    budget: Mapping[str, Any] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)

    @property
    def sparsity(self) -> float:
        """Share of the cells that the default plan reuses."""
        return self.plans[self.default_plan].sparsity

    @property
    def flops_sparsity(self) -> float:
        """The same share with each cell weighed by its FLOPs."""
        return self.plans[self.default_plan].flops_sparsity

    @property
    def validation_error(self) -> float:
        """Error of the default plan, in the units of the actions."""
        return self.plans[self.default_plan].error

    def record(self) -> dict[str, Any]:
        """As JSON, for the artifact. Without the time it took: the same calibration gives the same bytes."""
        record = asdict(self)
        del record["seconds"]
        if self.other_noise:
            for score in record["plans"].values():
                score["of_other_noise"] = score["error"] / self.other_noise
        record["episodes"] = {name: list(numbers) for name, numbers in self.episodes.items()}
        return record
