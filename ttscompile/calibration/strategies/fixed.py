"""Plans that are made at once, from a rule or from statistics of a few dense calls, without a search."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import CalibrationError
from ...lattice import PlanArray
from .base import Array, Found, Task

COMPARED = 16
"""Calls on which candidates are compared; fewer if there are fewer."""


@dataclass(frozen=True)
class Chosen:
    """A plan, and how it was chosen.

    Attributes:
        plan: ``[K, blocks]``.
        error: of the calls that it was compared on, normalised.
        notes: its parameters; JSON.
    """

    plan: PlanArray
    error: float
    notes: Mapping[str, Any]


class Fixed:
    """A strategy of one interval.

    Args:
        task: see ``Task``.
        choose: makes the plan.
    """

    intervals = 1
    closing = 0
    settling = 0.0

    def __init__(self, task: Task, choose: Callable[[Task], Chosen]) -> None:
        self._task, self._choose = task, choose
        model = task.executor.model
        self._chosen = Chosen(np.zeros((model.steps, model.blocks), np.int8), float("nan"), {})
        self._finished = False

    @property
    def done(self) -> bool:
        """Whether the plan was made."""
        return self._finished

    @property
    def loss(self) -> float:
        """Error of the plan."""
        return self._chosen.error

    @property
    def plan(self) -> PlanArray:
        """The schedule; dense before it was made."""
        return self._chosen.plan

    def advance(self, interval: int) -> None:
        """Make the plan."""
        self._chosen, self._finished = self._choose(self._task), True

    def close(self) -> None:
        """Nothing is left out: it is one interval."""

    def state(self) -> dict[str, Array]:
        """The plan."""
        notes = np.frombuffer(json.dumps(self._chosen.notes, sort_keys=True).encode(), np.uint8)
        return {"plan": self._chosen.plan, "error": np.array(self._chosen.error), "notes": notes}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        notes = json.loads(state["notes"].tobytes())
        self._chosen = Chosen(np.array(state["plan"], np.int8), float(state["error"]), notes)
        self._finished = True

    def found(self) -> Found:
        """The schedule, and no pruner."""
        return Found(self._chosen.plan, None, self._chosen.notes)


def best_of(task: Task, candidates: Sequence[tuple[PlanArray, Mapping[str, Any]]]) -> Chosen:
    """The candidate with the lowest error of some of the calls to learn from; the first of equals.

    Args:
        task: see ``Task``.
        candidates: plans within the budget, each with its parameters.
    """
    calls = task.executor.selector.calls(task.calls, some_calls(task, COMPARED))
    samples = task.executor.run([plan for plan, _ in candidates], calls)
    errors = task.actions.errors(samples, calls.targets, units=False).mean(1)
    best = int(np.argmin(errors))
    return Chosen(candidates[best][0], float(errors[best]), candidates[best][1])


def some_calls(task: Task, count: int) -> Array:
    """Numbers of ``count`` of the calls to learn from, always the same ones; of all if there are fewer."""
    return task.draw(0).permutation(task.calls.count)[:count]


def require_cells(name: str, least: int, steps: int, blocks: int, budget: int) -> None:
    """Refuse a budget that a strategy cannot keep whatever its parameters.

    Args:
        name: of the strategy.
        least: cells that it computes at least.
        steps: K.
        blocks: number of residual blocks.
        budget: cells that may be computed.

    Raises:
        CalibrationError: says how much sparsity it can reach.
    """
    if budget < least:
        cells = steps * blocks
        raise CalibrationError(
            f"strategy {name!r} computes at least {least} of the {steps} x {blocks} cells, a sparsity of"
            f" {1 - least / cells:.4g}; the target of {1 - budget / cells:.4g} leaves {budget}. Lower the target, or"
            " take another strategy."
        )
