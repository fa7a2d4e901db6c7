"""EVO: a genetic search over the cells, with the true error of the executed actions as fitness.

Source: arXiv 2607.20293, whose fitness is the success of rollouts; here it is the error against the dense policy on
recorded calls, which needs no simulator (``examples/evaluation/evolved.py`` has both). Population 30, tournaments of 3,
crossover 0.8, mutation 0.1, and at least 4 computed cells a block, as there; every plan has exactly as many computed
cells as the budget. An interval is a generation. The first has random plans and the whole-step plans of ``crowded``,
and the best plan always survives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.task import Array, Found, NothingAfter, Task
from ttscompile.core.lattice import BoolArray, PlanArray, Source, whole_steps_plan

from .dense import some_calls

POPULATION, GENERATIONS = 30, 100

TOURNAMENT, CROSSOVER, MUTATION = 3, 0.8, 0.1

MEASURED = 32
"""Calls that the fitness is measured on, always the same ones; fewer if there are fewer."""

LEAST = 4
"""Computed cells a block, if the budget has room for them."""


Fitness = Callable[[PlanArray], float]
"""Of a schedule ``[K, blocks]``; the smaller the better."""


class Evo(NothingAfter):
    """The genetic search of this module; see ``Search``.

    Args:
        fitness: None for the error.
        population: schedules of a generation.
    """

    intervals = GENERATIONS

    def __init__(self, task: Task, fitness: Fitness | None = None, population: int = POPULATION) -> None:
        self._task, self._size = task, population
        measured = some_calls(task, MEASURED)
        self._fitness = fitness or (lambda plan: task.error(plan, measured))
        model = task.runner.model
        self._least = min(LEAST, task.budget // model.blocks)
        self._population: BoolArray = self._first()
        self._errors = np.full(len(self._population), np.inf)

    @property
    def plan(self) -> PlanArray:
        """The best schedule so far."""
        return _plan(self._population[int(np.argmin(self._errors))])

    @property
    def loss(self) -> float:
        """Fitness of the best schedule: the error on the calls that all plans are compared on."""
        return float(self._errors.min()) if self._interval else float("nan")

    def advance(self, interval: int) -> None:
        """Measure the first generation, or breed another one."""
        if interval == 0:
            self._errors = self._measure(self._population)
        else:
            children = self._children(self._task.draw(interval, 0))
            best = int(np.argmin(self._errors))
            self._population = np.concatenate([self._population[best : best + 1], children])
            self._errors = np.append(self._errors[best], self._measure(children))
        self._interval = interval + 1

    def state(self) -> dict[str, Array]:
        """The current generation."""
        return {
            "population": self._population.astype(np.int8),
            "errors": self._errors,
            "generation": np.array(self._interval),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        self._population = np.array(state["population"], np.bool_)
        self._errors, self._interval = np.array(state["errors"]), int(state["generation"])

    def found(self) -> Found:
        """The best schedule, and no pruner."""
        return Found(self.plan, {"generations": self._interval})

    def _first(self) -> BoolArray:
        """Whole-step plans, and random ones."""
        task, model = self._task, self._task.runner.model
        draw = task.draw(10**6)
        family = spacings(model.steps, max(1, task.budget // model.blocks))
        whole = [whole_steps_plan(model.steps, model.blocks, steps) == Source.COMPUTE for steps in family]
        whole = whole[: self._size]
        random = draw.random((self._size - len(whole), *whole[0].shape)) < task.budget / whole[0].size
        return np.stack([repair(one, task.budget, self._least, draw) for one in (*whole, *random)])

    def _children(self, draw: np.random.Generator) -> BoolArray:
        """All of the next generation but the best of this one."""
        children = []
        for _ in range(self._size - 1):
            rivals = [draw.integers(len(self._population), size=TOURNAMENT) for _ in range(2)]
            first, second = (self._population[some[np.argmin(self._errors[some])]] for some in rivals)
            child = first.copy()
            if draw.random() < CROSSOVER:
                child = np.where(draw.random(child.shape) < 0.5, first, second)
            if draw.random() < MUTATION:
                child = mutate(child, draw)
            children.append(repair(child, self._task.budget, self._least, draw))
        return np.stack(children)

    def _measure(self, computed: BoolArray) -> Array:
        """Fitness of each plan; infinite where there was no time for it."""
        errors = np.full(len(computed), np.inf)
        for i in self._task.clock.in_time(range(len(computed))):
            errors[i] = self._fitness(_plan(computed[i]))
        return errors


def mutate(computed: BoolArray, draw: np.random.Generator) -> BoolArray:
    """Move a tenth of the computed cells after step 0 (at least one) to other steps of their blocks."""
    changed = computed.copy()
    steps, blocks = np.nonzero(computed[1:])
    if not len(steps):
        return changed
    moved = draw.permutation(len(steps))[: max(1, len(steps) // 10)]
    changed[1 + steps[moved], blocks[moved]] = False
    changed[draw.integers(1, len(computed), len(moved)), blocks[moved]] = True
    return changed


def repair(computed: BoolArray, budget: int, least: int, draw: np.random.Generator) -> BoolArray:
    """The plan with step 0 dense, at least ``least`` cells a block, and exactly ``budget`` cells; changed at random.

    Args:
        computed: bool ``[K, blocks]``.
        budget: at least ``least`` for each block, at most all cells.
        least: at least 1, at most K.
        draw: the source of random numbers.
    """
    fixed = computed.copy()
    fixed[0] = True
    for b in np.flatnonzero(fixed.sum(0) < least):
        reused = np.flatnonzero(~fixed[:, b])
        fixed[draw.permutation(reused)[: least - int(fixed[:, b].sum())], b] = True
    while (surplus := int(fixed.sum()) - budget) > 0:
        allowed = fixed & (fixed.sum(0) > least)
        allowed[0] = False
        # One cell a block at a time, so that no block falls below the least.
        cells = draw.permutation(np.flatnonzero(allowed.reshape(-1)))
        _, first = np.unique(cells % fixed.shape[1], return_index=True)
        fixed.reshape(-1)[cells[np.sort(first)][:surplus]] = False
    missing = budget - int(fixed.sum())
    fixed.reshape(-1)[draw.permutation(np.flatnonzero(~fixed.reshape(-1)))[:missing]] = True
    return fixed


def _plan(computed: BoolArray) -> PlanArray:
    return np.where(computed, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
