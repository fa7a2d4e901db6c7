"""Strategies that choose a criterion: its threshold for the budget, and what it decides on recorded calls.

Source of the criteria: ``teacache`` and ``dbcache``. The number of computed cells differs from call to call, so the
budget is kept on average: the threshold is the lowest, found by bisection, with which the mean over some of the calls
to learn from and two standard errors more are within it.

The schedule that comes with a criterion is a decision of its own, frozen: of the plans that it decided on the calls to
learn from, the one with the lowest error on all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, repeat

import numpy as np
import torch
from torch import Tensor

from ...core.lattice import PlanArray, Source
from ...errors import CalibrationFailedError
from ...runtimes.criterion import Criterion
from ..calls import Calls
from ..execute import Executor, State, last
from .base import Array, Task
from .fixed import COMPARED, Chosen, best_of

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
    model, state = executor.model, State()
    decisions = criterion.begin(model.steps, model.blocks, calls.count)
    first, others = range(criterion.always), range(criterion.always, model.blocks)
    computed = np.full((1, model.blocks), Source.COMPUTE, np.int8)
    rows: list[PlanArray] = []

    def blocks(k: int, stem: Tensor) -> Tensor:
        stream = executor.step(computed, k, stem, calls, state, first)
        feature = torch.stack([state.timestep[b] for b in first]).sum(0) if first else stem
        rows.append(decisions.decide(k, np.ascontiguousarray(feature.movedim(executor.axes[0], 0).numpy())))
        return executor.step(rows[-1], k, stream, calls, state, others)

    with torch.no_grad():
        sample = last(executor.samples(calls, blocks))
    return Decided(np.stack(rows, 1), sample)


def fit_threshold(
    task: Task, criterion: Criterion, calls: Calls, low: float, high: float, probes: Iterator[object]
) -> tuple[Criterion, Decided] | None:
    """The criterion with the lowest threshold that keeps the budget, as far as bisection finds it.

    Args:
        task: see ``Task``.
        criterion: with any threshold.
        calls: whose computed cells are counted.
        low: a threshold that is probably too low.
        high: one that probably is not; doubled until it is not.
        probes: as many as there is time for.

    Returns:
        The criterion, and what it decides on the calls; None if the time was up before one kept the budget.
    """
    found: tuple[Criterion, Decided] | None = None

    def fits(threshold: float) -> bool:
        nonlocal found
        tried = replace(criterion, threshold=threshold)
        decided = decide(task.executor, tried, calls)
        kept = bool(decided.cells.mean() + 2 * decided.cells.std() / len(decided.cells) ** 0.5 <= task.budget)
        found = (tried, decided) if kept else found
        return kept

    for _ in islice(probes, DOUBLINGS):
        if fits(high):
            break
        low, high = high, 2 * high
    for _ in islice(probes, HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return found


def online(task: Task, proposed: Sequence[tuple[Criterion, float]]) -> Chosen:
    """Fit every criterion that is proposed, take the best, and fit it again on more calls.

    Args:
        task: see ``Task``.
        proposed: criteria, each with a threshold to begin with.

    Raises:
        CalibrationFailedError: the time was up before one kept the budget.
    """
    probes, some, more = task.clock.in_time(repeat(None)), task.some_calls(COMPARED), task.some_calls(COUNTED)
    fitted = [fit_threshold(task, criterion, some, 0.0, start, probes) for criterion, start in proposed]
    kept = [one for one in fitted if one is not None]
    if not kept:
        raise CalibrationFailedError(
            f"the time limit ended the search for a threshold of {proposed[0][0].name!r} before one kept the budget of"
            f" {task.budget} computed cells. The artifact is as it was. Allow more time, or lower the target."
        )
    errors = [_error(task, decided, some) for _, decided in kept]
    best, decided = kept[int(np.argmin(errors))]
    calls, near = some, max(best.threshold, 1e-6)
    again = fit_threshold(task, best, more, near / 2, near, probes)
    if again is not None:
        (best, decided), calls = again, more
    chosen = best_of(task, [(plan, {}) for plan in within(decided.plans, task.budget)[:FROZEN]])
    cells = {"mean": float(decided.cells.mean()), "most": int(decided.cells.max())}
    notes = {"criterion": best.record(), "computed_cells": cells}
    return Chosen(chosen.plan, _error(task, decided, calls), notes, best)


def _error(task: Task, decided: Decided, calls: Calls) -> float:
    """Of the plans that were decided."""
    return float(task.actions.errors(decided.samples, calls.targets, units=False).mean())


def within(plans: PlanArray, budget: int) -> list[PlanArray]:
    """The different ones of ``plans [N, K, blocks]`` that are within the budget, in order."""
    computed = (plans == Source.COMPUTE).sum((1, 2))
    return list({plan.tobytes(): plan for plan in plans[computed <= budget]}.values())
