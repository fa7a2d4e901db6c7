"""Delta-DiT: between full steps the rear blocks are reused at first, and the front blocks later.

Source: Chen et al., Delta-DiT: A Training-Free Acceleration Method Tailored for Diffusion Transformers, 2024 (arXiv
2406.01125). The change that a span of blocks makes is cached there; with additive residuals that is the sum of their
cached residuals. The outline of the sample is made early and by the front blocks, its detail late and by the rear
ones. How many blocks stay fresh, and where late begins, is left to the user; here the calls to learn from decide.
"""

from __future__ import annotations

from ...core.lattice import PlanArray, Source, uniform_plan
from ..task import Found, Task
from .fixed import best_of, fixed

BOUNDARIES = (0.25, 0.5, 0.75)
"""Share of the steps after which it is the front blocks that are reused."""


def delta_plan(steps: int, blocks: int, full_steps: int, fresh: int, boundary: int) -> PlanArray:
    """Evenly spaced full steps; between them the first ``fresh`` blocks are computed, after ``boundary`` the last ones.

    Returns:
        int8 ``[K, blocks]``.
    """
    plan = uniform_plan(steps, blocks, full_steps)
    plan[:boundary, :fresh] = Source.COMPUTE
    plan[boundary:, blocks - fresh :] = Source.COMPUTE
    return plan


def candidates(steps: int, blocks: int, budget: int) -> list[tuple[PlanArray, dict[str, int]]]:
    """For each number of fresh blocks and each boundary, as many full steps as the budget has room for."""
    found = []
    for fresh in range(1, max(2, blocks)):
        cached = max(1, blocks - fresh)
        full_steps = min(steps, (budget - fresh * steps) // cached)
        if full_steps < 1:
            break
        for share in BOUNDARIES:
            boundary = round(share * steps)
            plan = delta_plan(steps, blocks, full_steps, fresh, boundary)
            found.append((plan, {"fresh": fresh, "full_steps": full_steps, "boundary": boundary}))
    return found


@fixed
def delta_dit(task: Task) -> Found:
    """The best of ``candidates``."""
    model = task.executor.model
    return best_of(task, candidates(model.steps, model.blocks, task.budget))
