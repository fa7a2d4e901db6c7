"""Searches of one interval: a plan from a rule, or from statistics of a few calls."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ttscompile.calibration.task import Array, Found, NothingAfter, Task
from ttscompile.core.lattice import PlanArray, dense_plan

from .dense import some_calls

COMPARED = 16
"""Calls on which candidates are compared; fewer if there are fewer."""


class Fixed(NothingAfter):
    """A search of one interval."""

    def __init__(self, task: Task, choose: Callable[[Task], Found]) -> None:
        self._task, self._choose = task, choose
        model = task.runner.model
        self._found = Found(dense_plan(model.steps, model.blocks))

    @property
    def loss(self) -> float:
        """Error of the plan on the calls that it was chosen on."""
        return self._found.error

    @property
    def plan(self) -> PlanArray:
        """The schedule; dense before it was made."""
        return self._found.schedule

    def advance(self, interval: int) -> None:
        """Make the plan."""
        self._found, self._interval = self._choose(self._task), 1

    def state(self) -> dict[str, Array]:
        """The plan."""
        notes = np.frombuffer(json.dumps(self._found.notes, sort_keys=True).encode(), np.uint8)
        return {"plan": self.plan, "error": np.array(self.loss), "notes": notes}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        notes = json.loads(state["notes"].tobytes())
        self._found = Found(np.array(state["plan"], np.int8), notes, error=float(state["error"]))
        self._interval = 1

    def found(self) -> Found:
        """The schedule, and no pruner."""
        return self._found


def fixed(choose: Callable[[Task], Found]) -> Callable[[Task], Fixed]:
    """Make a search of a function that chooses a plan; a decorator."""
    return partial(Fixed, choose=choose)


def best_of(task: Task, candidates: Sequence[tuple[PlanArray, Mapping[str, Any]]]) -> Found:
    """The candidate with the lowest error of some of the calls to learn from; the first of equals."""
    calls = some_calls(task, COMPARED)
    errors = [task.error(plan, calls) for plan, _ in task.clock.in_time(candidates)]
    best = int(np.argmin(errors))
    return Found(*candidates[best], error=errors[best])
