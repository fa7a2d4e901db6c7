"""Plans beside the target: ``safe`` computes twice as many cells, ``fast`` half as many; the robot chooses.

Both are whole steps, the best of the crowded family, with a correction fitted on all calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from ..correction import Correction
from ..lattice import PlanArray
from .families import Families
from .strategies import Found, Task
from .whole_steps import WholeSteps

Kept = TypeVar("Kept")

SAFE, FAST = "safe", "fast"

SHARE = 0.2
"""Of the time that is kept from the search, for these plans."""


@dataclass(frozen=True)
class Named:
    """Plans beside the target.

    Attributes:
        plans: int8 ``[K, blocks]`` by name.
        corrections: of those that are better with one.
        steps: that each computes, for the record.
        skipped: why a name has no plan.
    """

    plans: Mapping[str, PlanArray] = field(default_factory=dict)
    corrections: Mapping[str, Correction] = field(default_factory=dict)
    steps: Mapping[str, list[int]] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)

    def without(self, name: str, reason: str) -> Named:
        """The same without one of the plans, and why."""

        def rest(of: Mapping[str, Kept]) -> dict[str, Kept]:
            return {key: value for key, value in of.items() if key != name}

        return Named(rest(self.plans), rest(self.corrections), rest(self.steps), {**self.skipped, name: reason})


def named_plans(families: Families, whole: WholeSteps, task: Task, strategy: str, cells: int) -> Named:
    """Those of ``safe`` and ``fast`` that can be made.

    Args:
        families: compares schedules.
        whole: makes them.
        task: with the calls that corrections are fitted on.
        strategy: that found the target's plan; only ``tts`` has corrections.
        cells: computed by the target's plan.
    """
    if strategy != "tts":
        reason = f"strategy {strategy!r} fits no correction"
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
    plans, corrections, steps = {}, {}, {}
    for name, count in counts.items():
        best = families.best(count, f"plan {name}")
        if best is None:
            skipped[name] = "the time limit left none for it"
            continue
        plans[name], steps[name] = whole.plan(best.steps), list(best.steps)
        correction = whole.correction(best.steps)
        if correction is not None:
            corrections[name] = correction
    return Named(plans, corrections, steps, skipped)


def relaxed(found: Found, families: Families, whole: WholeSteps, task: Task, full_steps: int) -> Found | None:
    """What to take instead where the target's plan misses an error on held-out calls: more steps.

    Args:
        found: what missed it.
        families: compares schedules.
        whole: makes them.
        task: with the calls that corrections are fitted on.
        full_steps: how many to compute.

    Returns:
        A schedule with its correction, and no pruner; None if there is no time for it.
    """
    best = families.best(full_steps, f"{full_steps} steps")
    if best is None:
        return None
    plan = whole.plan(best.steps)
    notes = {**found.notes, "steps": list(best.steps), "switches": 0}
    return Found(plan, None, notes, correction=whole.correction(best.steps))
