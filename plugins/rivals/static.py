"""Plans from a rule, without looking at residuals: ``interval``, ``delta_dit`` and ``deepcache``.

- ``interval``: every block computed at evenly spaced steps: the baseline that every other schedule is held against.
  Source: FORA (2024) and the action head of EfficientVLA (NeurIPS 2025), see ``docs/design.md`` section 7.
- ``delta_dit``: between full steps the rear blocks are reused at first, and the front blocks later. Source: Chen et
  al., Delta-DiT: A Training-Free Acceleration Method Tailored for Diffusion Transformers, 2024 (arXiv 2406.01125). The
  change that a span of blocks makes is cached there; with additive residuals that is the sum of their cached residuals.
  The outline of the sample is made early and by the front blocks, its detail late and by the rear ones.
- ``deepcache``: the outermost blocks are computed at every step, everything between them at evenly spaced steps.
  Source: Ma et al., DeepCache: Accelerating Diffusion Models for Free, CVPR 2024 (arXiv 2312.00858). There the
  outermost blocks are the shallow branch of a U-Net; in a chain of blocks they are the first and the last ones.

How many blocks stay fresh or outermost, and where late begins, is left to the user there; here the calls to learn from
decide.
"""

from __future__ import annotations

from ttscompile.calibration.task import Found, Task
from ttscompile.core.lattice import PlanArray, Source, uniform_plan

from .fixed import best_of, fixed

BOUNDARIES = (0.25, 0.5, 0.75)
"""Of Delta-DiT: share of the steps after which it is the front blocks that are reused."""

Candidates = list[tuple[PlanArray, dict[str, int]]]
"""Plans, each with its parameters."""


@fixed
def interval(task: Task) -> Found:
    """The one schedule that there is."""
    steps, blocks = task.runner.model.steps, task.runner.model.blocks
    return best_of(task, [(uniform_plan(steps, blocks, max(1, task.budget // blocks)), {})])


@fixed
def delta_dit(task: Task) -> Found:
    """The best of ``delta_plans``."""
    return best_of(task, delta_plans(task.runner.model.steps, task.runner.model.blocks, task.budget))


def delta_plan(steps: int, blocks: int, full_steps: int, fresh: int, boundary: int) -> PlanArray:
    """Evenly spaced full steps; between them the first ``fresh`` blocks are computed, after ``boundary`` the last ones.

    Returns:
        int8 ``[K, blocks]``.
    """
    plan = uniform_plan(steps, blocks, full_steps)
    plan[:boundary, :fresh] = Source.COMPUTE
    plan[boundary:, blocks - fresh :] = Source.COMPUTE
    return plan


def delta_plans(steps: int, blocks: int, budget: int) -> Candidates:
    """For each number of fresh blocks and each boundary, as many full steps as the budget has room for."""
    found = []
    for fresh in range(1, blocks):
        full_steps = min(steps, (budget - fresh * steps) // (blocks - fresh))
        if full_steps < 1:
            break
        for boundary in (round(share * steps) for share in BOUNDARIES):
            plan = delta_plan(steps, blocks, full_steps, fresh, boundary)
            found.append((plan, {"fresh": fresh, "full_steps": full_steps, "boundary": boundary}))
    return found


@fixed
def deepcache(task: Task) -> Found:
    """The best of ``edge_plans``."""
    return best_of(task, edge_plans(task.runner.model.steps, task.runner.model.blocks, task.budget))


def edge_plan(steps: int, blocks: int, full_steps: int, edge: int) -> PlanArray:
    """The first and the last ``edge`` blocks computed at every step, the others at ``full_steps``: ``[K, blocks]``."""
    plan = uniform_plan(steps, blocks, full_steps)
    plan[:, :edge] = plan[:, blocks - edge :] = Source.COMPUTE
    return plan


def edge_plans(steps: int, blocks: int, budget: int) -> Candidates:
    """For each width of the edge, the plan with as many full steps as the budget has room for."""
    found = []
    for edge in range(1, -(-blocks // 2)):
        full_steps = min(steps, (budget - 2 * edge * steps) // (blocks - 2 * edge))
        if full_steps >= 1:
            found.append((edge_plan(steps, blocks, full_steps, edge), {"edge": edge, "full_steps": full_steps}))
    return found
