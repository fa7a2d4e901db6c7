"""DeepCache: the outermost blocks are computed at every step, everything between them at evenly spaced steps.

Source: Ma et al., DeepCache: Accelerating Diffusion Models for Free, CVPR 2024 (arXiv 2312.00858). There the outermost
blocks are the shallow branch of a U-Net; in a chain of blocks they are the first and the last ones, as in
``docs/design.md``'s lattice. How many there are is left to the user; here the calls to learn from decide.
"""

from __future__ import annotations

from ...core.lattice import PlanArray, Source, dense_plan, uniform_plan
from ..task import Found, Task
from .fixed import best_of, fixed


def edge_plan(steps: int, blocks: int, full_steps: int, edge: int) -> PlanArray:
    """The first and the last ``edge`` blocks computed at every step, the others at ``full_steps`` steps.

    Returns:
        int8 ``[K, blocks]``.
    """
    plan = uniform_plan(steps, blocks, full_steps)
    plan[:, :edge] = Source.COMPUTE
    plan[:, blocks - edge :] = Source.COMPUTE
    return plan


def candidates(steps: int, blocks: int, budget: int) -> list[tuple[PlanArray, dict[str, int]]]:
    """For each width of the edge, the plan with as many full steps as the budget has room for."""
    if blocks <= 2:  # nothing is between them
        return [(dense_plan(steps, blocks), {"edge": 1, "full_steps": steps})]
    found = []
    for edge in range(1, -(-blocks // 2)):
        inner = blocks - 2 * edge
        full_steps = min(steps, (budget - 2 * edge * steps) // inner)
        if full_steps >= 1:
            plan = edge_plan(steps, blocks, full_steps, edge)
            found.append((plan, {"edge": edge, "full_steps": full_steps}))
    return found


@fixed
def deepcache(task: Task) -> Found:
    """The best of ``candidates``."""
    model = task.executor.model
    return best_of(task, candidates(model.steps, model.blocks, task.budget))
