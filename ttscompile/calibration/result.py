"""What a calibration achieved, on episodes that it did not learn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from ..artifact.ceiling import FARTHEST
from .budget import DISTANCE, ERROR
from .judge import Score


@dataclass(frozen=True)
class CalibrationResult:
    """The outcome of a calibration.

    Attributes:
        learned: names of the proposers that took part.
        strategy: how the schedule was found.
        seed: the seed of everything random.
        target_sparsity: what was asked for, or what the budget comes to.
        default_plan: the plan that the artifact now uses; a key of ``plans``.
        plans: every plan that was kept, by name; ``uniform`` is the baseline that computes as much.
        episodes: numbers of the episodes in the order of the files, learned from and judged on.
        calls: how many calls of these were used; of those that are judged on every one with several draws of noise.
        intervals: how many intervals the search took.
        stopped: why it ended: ``finished`` or ``time limit``.
        seconds: of work, the parts before an interruption included.
        other_noise: mean absolute difference of the executed actions of two dense calls on one observation with
            different noise, in the units of the actions; None if it was not measured.
        budget: what was asked for, the cells that it comes to, and what was measured for it; JSON.
        skipped: why there is no plan of a name that there might be.
        told: by proposer, what became of it.
        frontier: where the default was chosen among many plans, all of them, fastest first; JSON.
    """

    learned: tuple[str, ...]
    strategy: str
    seed: int
    target_sparsity: float
    default_plan: str
    plans: Mapping[str, Score]
    episodes: Mapping[str, tuple[int, ...]]
    calls: Mapping[str, int]
    intervals: int
    stopped: str
    seconds: float
    other_noise: float | None = None
    budget: Mapping[str, Any] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    told: Mapping[str, str] = field(default_factory=dict)
    frontier: tuple[Mapping[str, Any], ...] = ()

    @property
    def doubtful(self) -> bool:
        """Whether scores may fall, so far from the original is the default plan, and nobody said how far it may be."""
        return not {ERROR, DISTANCE} & self.budget.keys() and self.plans[self.default_plan].distance > FARTHEST

    @property
    def sparsity(self) -> float:
        """Share of the cells that the default plan reuses."""
        return self.plans[self.default_plan].sparsity

    @property
    def flops_sparsity(self) -> float:
        """The same share with each cell weighed by its FLOPs."""
        return self.plans[self.default_plan].flops_sparsity

    def record(self) -> dict[str, Any]:
        """As JSON, for the artifact. Without the time it took: the same calibration gives the same bytes."""
        record = asdict(self)
        del record["seconds"]
        record["plans"] = {name: score.record() for name, score in self.plans.items()}
        record["frontier"] = [dict(one) for one in self.frontier]
        if not record["frontier"]:
            del record["frontier"]
        record["episodes"] = {name: list(numbers) for name, numbers in self.episodes.items()}
        return record
