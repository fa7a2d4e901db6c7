"""Strategies of one interval: a plan from a rule, or from statistics of a few calls."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np

from ...core.lattice import PlanArray, dense_plan
from ..task import Array, Found, NothingAfter, Task

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


class Fixed(NothingAfter):
    """A strategy of one interval.

    Args:
        task: see ``Task``.
        choose: makes the plan.

    Attributes:
        done: whether it was made.
    """

    intervals = 1

    def __init__(self, task: Task, choose: Callable[[Task], Chosen]) -> None:
        self._task, self._choose = task, choose
        model = task.executor.model
        self._chosen = Chosen(dense_plan(model.steps, model.blocks), float("nan"), {})
        self.done = False

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
        self._chosen, self.done = self._choose(self._task), True

    def state(self) -> dict[str, Array]:
        """The plan."""
        notes = np.frombuffer(json.dumps(self._chosen.notes, sort_keys=True).encode(), np.uint8)
        return {"plan": self._chosen.plan, "error": np.array(self._chosen.error), "notes": notes}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        notes = json.loads(state["notes"].tobytes())
        self._chosen = Chosen(np.array(state["plan"], np.int8), float(state["error"]), notes)
        self.done = True

    def found(self) -> Found:
        """The schedule, and no pruner."""
        return Found(self._chosen.plan, self._chosen.notes)


def fixed(choose: Callable[[Task], Chosen]) -> Callable[[Task], Fixed]:
    """Make a strategy of a function that chooses a plan; a decorator."""

    @wraps(choose)
    def strategy(task: Task) -> Fixed:
        return Fixed(task, choose)

    return strategy


def best_of(task: Task, candidates: Sequence[tuple[PlanArray, Mapping[str, Any]]]) -> Chosen:
    """The candidate with the lowest error of some of the calls to learn from; the first of equals.

    Args:
        task: see ``Task``.
        candidates: plans within the budget, each with its parameters; as many are compared as there is time for.
    """
    calls = task.some_calls(COMPARED)
    errors = [task.error(plan, calls) for plan, _ in task.clock.in_time(candidates)]
    best = int(np.argmin(errors))
    return Chosen(candidates[best][0], errors[best], candidates[best][1])
