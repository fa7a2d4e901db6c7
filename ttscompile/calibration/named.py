"""Plans beside the target: ``safe`` computes twice as many cells, ``fast`` half as many; the robot chooses.

Both are whole steps, the best of the crowded family, with a correction fitted on all calls.
"""

from __future__ import annotations

from .crowded import CrowdedSchedules
from .strategies import Strategy
from .task import Found, Task

SAFE, FAST = "safe", "fast"

SHARE = 0.2
"""Share of the time limit that is kept from the search for these plans."""


def named_plans(
    crowded: CrowdedSchedules, task: Task, strategy: Strategy, cells: int
) -> tuple[dict[str, Found], dict[str, str]]:
    """Make ``safe`` and ``fast``, where they can be made.

    Args:
        crowded: compares crowded schedules.
        task: has the calls that corrections are fitted on.
        strategy: the strategy that found the target's plan.
        cells: how many cells the target's plan computes.

    Returns:
        Plans by name, with the computed steps in their notes; and by name why there is no plan.
    """
    if not strategy.fits_correction:
        reason = f"strategy {strategy.name!r} fits no correction"
        return {}, {SAFE: reason, FAST: reason}
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
    return plans, skipped
