"""From a settled schedule to plans that depend on the observation: learn switches, and keep those that hold."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration.pruner.head import has_head
from ..calibration.task import Array, Task
from ..core.lattice import PlanArray, Source
from ..runtimes.plans import pruner_plan
from .linear import Matrix, linearise
from .switches import capacity, fit_switches, head_features, head_weights

LINEARISED = 32
"""Calls that an interval linearises."""

COUNTS = (1, 2, 4, 8, 16, 32)
"""Numbers of switches that are tried, best first."""


class Adaptation:
    """Intervals after the search: all but the last linearise, the last one fits.

    Args:
        task: see ``Task``.
        schedule: ``[K, blocks]``, settled.

    Attributes:
        done: whether nothing is left to do.
        pruner: constants of the pruner; None before the last interval, or if no switch helps.
        switches: how many switches the pruner has.
    """

    INTERVALS = 5
    KEY = "adapted"

    def __init__(self, task: Task, schedule: PlanArray) -> None:
        self._task, self._schedule = task, schedule
        self._effects: list[Matrix] = []
        self._errors: list[Matrix] = []
        self.done = not has_head(task.pruner) or task.calls.count < 2
        self.pruner: dict[str, Array] | None = None
        self.switches = 0
        # Two thirds to learn from, at most what the intervals linearise; the rest decides whether it was worth it.
        self._order = task.draw(10**6).permutation(task.calls.count)
        self._learned = min(LINEARISED * (self.INTERVALS - 1), 2 * task.calls.count // 3)

    def advance(self) -> None:
        """Linearise some more calls; with all of them, fit."""
        known = sum(len(error) for error in self._errors)
        if known < self._learned:
            task, numbers = self._task, self._order[known : min(known + LINEARISED, self._learned)]
            calls, seed = task.executor.select(task.calls, numbers), int(task.draw(known, 2).integers(2**31))
            model = linearise(task.executor, task.actions, self._schedule, calls, seed)
            self._effects.append(model.toggles().reshape(*self._schedule.shape, len(numbers), -1))
            self._errors.append(model.error.reshape(len(numbers), -1))
            return
        self._fit()
        self.done = True

    def state(self) -> dict[str, Array]:
        """What was learned."""
        state: dict[str, Array] = {self.KEY: np.array(int(self.done)), "switches": np.array(self.switches)}
        for i, (effects, error) in enumerate(zip(self._effects, self._errors, strict=True)):
            state[f"effects{i}"], state[f"error{i}"] = effects, error
        return {**state, **(self.pruner or {})}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        self.done, self.switches = bool(state[self.KEY]), int(state["switches"])
        count = sum(name.startswith("effects") for name in state)
        self._effects = [state[f"effects{i}"] for i in range(count)]
        self._errors = [state[f"error{i}"] for i in range(count)]
        pruner = {name: array for name, array in state.items() if name.startswith("pruner.")}
        self.pruner = pruner or None

    def _fit(self) -> None:
        """Learn switches, and keep as many of them as lower the true error of calls that they were not learned from."""
        task = self._task
        graph = task.executor.pruner_graph
        assert graph is not None  # has_head
        features = head_features(graph, task.calls)
        learned, others = self._order[: self._learned], self._order[self._learned :]
        switches = fit_switches(
            effects=np.concatenate(self._effects, axis=2),
            error=np.concatenate(self._errors),
            computed=self._schedule == Source.COMPUTE,
            features=features[learned],
            episodes=task.calls.episodes[learned],
            count=capacity(task.pruner),
        )
        calls = task.executor.select(task.calls, others)
        base = task.error(self._schedule, calls)
        for count in dict.fromkeys(min(n, len(switches)) for n in COUNTS):
            weights = head_weights(task.pruner, self._schedule, switches[:count], features)
            error = task.error(pruner_plan(task.executor.logits(calls, weights)), calls)
            if count and error < base:
                base, self.pruner, self.switches = error, weights, count
