"""Plans beside the target: ``safe`` computes twice as many cells, ``fast`` half as many; the robot chooses.

Both are whole steps, the best of the crowded family, with a correction fitted on all calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .crowded import CrowdedSchedules
from .strategies import Strategy
from .task import Found, Task

SAFE, FAST = "safe", "fast"

SHARE = 0.2
"""Of the time that is kept from the search, for these plans."""


@dataclass(frozen=True)
class Named:
    """Plans beside the target.

    Attributes:
        plans: by name; the steps that a plan computes are in its notes.
        skipped: why a name has no plan.
    """

    plans: Mapping[str, Found] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)

    def without(self, name: str, reason: str) -> Named:
        """The same without one of the plans, and why."""
        kept = {other: plan for other, plan in self.plans.items() if other != name}
        return Named(kept, {**self.skipped, name: reason})


def named_plans(crowded: CrowdedSchedules, task: Task, strategy: Strategy, cells: int) -> Named:
    """Those of ``safe`` and ``fast`` that can be made.

    Args:
        crowded: compares schedules.
        task: with the calls that corrections are fitted on.
        strategy: that found the target's plan.
        cells: computed by the target's plan.
    """
    if not strategy.fits_correction:
        reason = f"strategy {strategy.name!r} fits no correction"
        return Named(skipped={SAFE: reason, FAST: reason})
    model = task.executor.model
    target = max(1, cells // model.blocks)
    skipped: dict[str, str] = {}
    counts: dict[str, int] = {}
    if 2 * target < model.steps:
        counts[SAFE] = 2 * target
    else:
        skipped[SAFE] = f"twice {target} of {model.steps} steps is the dense plan"
    if target > 2:
        counts[FAST] = max(2, target // 2)
    else:
        skipped[FAST] = f"the target computes {target} whole step{'s' * (target > 1)}: half of that is too little"
    plans: dict[str, Found] = {}
    for name, count in counts.items():
        best = crowded.best(count, f"plan {name}")
        if best is None:
            skipped[name] = "the time limit left none for it"
        else:
            plans[name] = task.whole_steps(best.steps)
    return Named(plans, skipped)
