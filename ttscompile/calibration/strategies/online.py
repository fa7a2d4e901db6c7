"""Strategies that find a criterion: its threshold for the budget, and what it decides on recorded calls.

Source of the criteria: ``teacache`` and ``dbcache``. The number of computed cells differs from call to call, so the
budget is kept on average: the threshold is the lowest, found by bisection, with which the mean over some of the calls
to learn from and two standard errors more are within it.

The schedule that comes with a criterion is a decision of its own, frozen: of the plans that it decided on the calls to
learn from, the one with the lowest error on all of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...lattice import PlanArray, Source
from ...runtimes.criterion import Criterion
from ..calls import Calls
from ..execute import Executor
from .base import Array, Found, Task
from .fixed import COMPARED, best_of, some_calls

HALVINGS, DOUBLINGS = 9, 20
"""Of the interval that the threshold is in."""

COUNTED = 32
"""Calls whose computed cells decide the last threshold; fewer if there are fewer."""

FROZEN = 16
"""Decided plans at most that are compared."""


@dataclass(frozen=True)
class Decided:
    """What a criterion decided on some calls.

    Attributes:
        plans: int8 ``[N, K, blocks]``.
        samples: the denoised samples, ``[N, T, D]``.
    """

    plans: PlanArray
    samples: Tensor

    @property
    def cells(self) -> Array:
        """Computed cells of each call, ``[N]``."""
        return np.asarray((self.plans == Source.COMPUTE).sum((1, 2)))


def decide(executor: Executor, criterion: Criterion, calls: Calls) -> Decided:
    """Run calls with plans that the criterion decides step by step.

    Args:
        executor: of the policy.
        criterion: decides.
        calls: N of them.
    """
    model, axes = executor.model, executor.axes
    decisions = criterion.begin(model.steps, model.blocks, calls.count)
    cache: list[Tensor] = []
    rows: list[PlanArray] = []
    carried = model.begin(calls.initial)
    with torch.no_grad():
        for k in range(model.steps):
            stem = stream = model.stem(carried.sample, k, calls.contexts)
            first: list[Tensor] = []
            for b in range(criterion.always):
                first.append(model.block(b, k, stream, calls.contexts))
                stream = stream + first[-1]
            feature = (torch.stack(first).sum(0) if first else stem).movedim(axes[0], 0)
            rows.append(decisions.decide(k, np.ascontiguousarray(feature.numpy())))
            cache[: criterion.always] = first
            streams = torch.from_numpy(np.flatnonzero(rows[-1][:, -1] == Source.COMPUTE))
            for b in range(criterion.always, model.blocks):
                if k == 0:
                    cache.append(model.block(b, k, stream, calls.contexts))
                elif len(streams):
                    part = model.block(b, k, stream, calls.contexts, streams.tolist())
                    cache[b] = cache[b].index_copy(axes[b], streams, part)
                stream = stream + cache[b]
            prediction = model.tail(stream, k, calls.contexts)
            carried = model.advance(carried, prediction, None if calls.noise is None else calls.noise[k], k)
    return Decided(np.stack(rows, 1), carried.sample)


def fit_threshold(task: Task, criterion: Criterion, calls: Calls, low: float, high: float) -> Criterion:
    """The criterion with the lowest threshold that keeps the budget, as far as bisection finds it.

    Args:
        task: see ``Task``.
        criterion: with any threshold.
        calls: whose computed cells are counted.
        low: a threshold that is probably too low.
        high: one that probably is not; doubled until it is not.
    """

    def fits(threshold: float) -> bool:
        cells = decide(task.executor, replace(criterion, threshold=threshold), calls).cells
        return bool(cells.mean() + 2 * cells.std() / len(cells) ** 0.5 <= task.budget)

    for _ in range(DOUBLINGS):
        if fits(high):
            break
        low, high = high, 2 * high
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return replace(criterion, threshold=high)


class Online:
    """A strategy of one interval that finds a criterion.

    Args:
        task: see ``Task``.
        propose: the criteria to choose from, each with a threshold to begin with.
    """

    intervals = 1
    closing = 0
    settling = 0.0

    def __init__(self, task: Task, propose: Callable[[Task], Sequence[tuple[Criterion, float]]]) -> None:
        self._task, self._propose = task, propose
        model = task.executor.model
        self._plan: PlanArray = np.zeros((model.steps, model.blocks), np.int8)
        self._criterion: Criterion | None = None
        self._notes: dict[str, Any] = {}
        self._loss = float("nan")

    @property
    def done(self) -> bool:
        """Whether there is a criterion."""
        return self._criterion is not None

    @property
    def loss(self) -> float:
        """Error of the plans that the criterion decides."""
        return self._loss

    @property
    def plan(self) -> PlanArray:
        """The best that it decided; dense before there is one."""
        return self._plan

    def advance(self, interval: int) -> None:
        """Fit every criterion that is proposed, take the best, and fit it again on more calls."""
        task = self._task
        some, more = (
            task.executor.selector.calls(task.calls, some_calls(task, count)) for count in (COMPARED, COUNTED)
        )
        fitted = [fit_threshold(task, criterion, some, 0.0, start) for criterion, start in self._propose(task)]
        errors = [self._error(criterion, some) for criterion in fitted]
        best = fitted[int(np.argmin(errors))]
        near = max(best.threshold, 1e-6)
        self._criterion = fit_threshold(task, best, more, near / 2, near)
        decided = decide(task.executor, self._criterion, more)
        self._loss = float(task.actions.errors(decided.samples, more.targets, units=False).mean())
        self._plan = best_of(task, [(plan, {}) for plan in within(decided.plans, task.budget)[:FROZEN]]).plan
        self._notes = {
            "criterion": self._criterion.record(),
            "computed_cells": {"mean": float(decided.cells.mean()), "most": int(decided.cells.max())},
        }

    def _error(self, criterion: Criterion, calls: Calls) -> float:
        """Of the plans that it decides."""
        samples = decide(self._task.executor, criterion, calls).samples
        return float(self._task.actions.errors(samples, calls.targets, units=False).mean())

    def close(self) -> None:
        """Nothing is left out: it is one interval."""

    def state(self) -> dict[str, Array]:
        """The criterion, and the best that it decided."""
        notes = np.frombuffer(json.dumps(self._notes, sort_keys=True).encode(), np.uint8)
        return {"plan": self._plan, "loss": np.array(self._loss), "notes": notes}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        self._plan, self._loss = np.array(state["plan"], np.int8), float(state["loss"])
        self._notes = json.loads(state["notes"].tobytes())
        self._criterion = Criterion.from_record(self._notes["criterion"])

    def found(self) -> Found:
        """The criterion, and the schedule of the best that it decided."""
        return Found(self._plan, None, self._notes, criterion=self._criterion)


def within(plans: PlanArray, budget: int) -> list[PlanArray]:
    """The different ones of ``plans [N, K, blocks]`` that are within the budget, in order."""
    computed = (plans == Source.COMPUTE).sum((1, 2))
    return list({plan.tobytes(): plan for plan in plans[computed <= budget]}.values())
