"""Every block computed at evenly spaced steps: the baseline that every other strategy is held against."""

from __future__ import annotations

from collections.abc import Mapping

from ...lattice import PlanArray, uniform_plan
from .base import Array, Found, Task


class Interval:
    """No search.

    Source: FORA (2024) and the action head of EfficientVLA (NeurIPS 2025), see ``docs/design.md`` section 7.
    """

    intervals = 1
    closing = 0
    settling = 0.0
    done = True
    loss = float("nan")

    def __init__(self, task: Task) -> None:
        model = task.executor.model
        self._plan = uniform_plan(model.steps, model.blocks, max(1, task.budget // model.blocks))

    @property
    def plan(self) -> PlanArray:
        """The schedule."""
        return self._plan

    def advance(self, interval: int) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""

    def state(self) -> dict[str, Array]:
        """Nothing to keep."""
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Nothing to restore."""

    def found(self) -> Found:
        """The schedule, and no pruner."""
        return Found(self._plan, None, {}, is_baseline=True)
