"""Every block computed at evenly spaced steps: the baseline that every other strategy is held against.

Source: FORA (2024) and the action head of EfficientVLA (NeurIPS 2025), see ``docs/design.md`` section 7.
"""

from __future__ import annotations

from ...core.lattice import uniform_plan
from ..task import Found, Task
from .fixed import best_of, fixed


@fixed
def interval(task: Task) -> Found:
    """The one schedule that there is."""
    steps, blocks = task.executor.model.steps, task.executor.model.blocks
    return best_of(task, [(uniform_plan(steps, blocks, max(1, task.budget // blocks)), {})])
