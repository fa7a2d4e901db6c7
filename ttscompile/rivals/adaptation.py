"""From a settled schedule to plans that depend on the observation: learn switches, and keep those that hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..calibration.task import Array, Found, Task
from ..calibration.tts import Tts
from ..core.lattice import PlanArray, Source
from ..ir.plan_head import has_head
from ..runtimes.plans import pruner_plan
from .sensitivity import Matrix, linearise
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


class Switched(Tts):
    """The search of ``Tts``, and after it the switches, where the artifact has a pruner; see ``Search``.

    That never made a plan better that could be told from chance (``docs/evidence/ablation.md``), so ``tts`` does
    without.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._adaptation: Adaptation | None = None
        self.closing = Adaptation.INTERVALS if has_head(task.pruner) else 0
        self.intervals += self.closing

    @property
    def done(self) -> bool:
        """Whether the schedule is settled, and the pruner fitted to it where it may be."""
        return super().done and (self._adaptation is None or self._adaptation.done)

    def close(self) -> None:
        """Settle the schedule, and begin with the switches."""
        super().close()
        if self._adaptation is None and self.closing and (found := self._settled) is not None:
            corrected = replace(self._task, executor=self._task.executor.corrected(found.correction))
            self._adaptation = Adaptation(corrected, found.schedule)

    def advance(self, interval: int) -> None:
        """Go on with the schedule; or adapt the plan to observations."""
        if self._adaptation is None:
            super().advance(interval)
        else:
            self._adaptation.advance()

    def state(self) -> dict[str, Array]:
        """See ``Tts``; and what the switches are so far."""
        return {**super().state(), **({} if self._adaptation is None else self._adaptation.state())}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        super().restore(state)
        if self._adaptation is not None:
            self._adaptation.restore(state)

    def found(self) -> Found:
        """The schedule with its correction, and the pruner if plans that depend on the observation were better."""
        found = super().found()
        if self._adaptation is None:
            return found
        notes = {**found.notes, "switches": self._adaptation.switches}
        return replace(found, notes=notes, pruner=self._adaptation.pruner, pruner_correction=found.correction)
