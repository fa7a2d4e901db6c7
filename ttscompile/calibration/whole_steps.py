"""Schedules of whole steps, each with a correction of its own, and how good they are on calls it was not fitted on."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..core.correction import Correction
from ..core.lattice import PlanArray, whole_steps_plan
from .crowded import CROWDING, crowded_family
from .fit_correction import fit_correction

if TYPE_CHECKING:
    from .strategies.base import Task

FITTED, COMPARED = 384, 128
"""Calls on which a candidate's correction is fitted, and others on which its error is measured; fewer if there are
fewer."""


@dataclass(frozen=True)
class Errors:
    """Mean absolute error of the executed actions of a schedule.

    Attributes:
        normalised: as the network has them.
        units: in the units of the actions.
    """

    normalised: float
    units: float


class WholeSteps:
    """Compares schedules of whole steps.

    Args:
        task: see ``Task``; its budget is not used.
    """

    _pace = 0.0
    """Seconds that a comparison took, for each step that its schedule computes; the most so far."""

    def __init__(self, task: Task) -> None:
        self._task = task
        order = task.draw(0).permutation(task.calls.count)
        compared = max(1, min(COMPARED, task.calls.count // 4))
        select = task.executor.selector.calls
        self._compared = select(task.calls, order[:compared])
        self._fitted = select(task.calls, order[compared:][:FITTED]) if task.calls.count > 1 else self._compared

    def plan(self, steps: Sequence[int]) -> PlanArray:
        """The schedule that computes these steps and reads TIMESTEP elsewhere, int8 ``[K, blocks]``."""
        model = self._task.executor.model
        return whole_steps_plan(model.steps, model.blocks, steps)

    def errors(self, steps: Sequence[int]) -> Errors:
        """Errors of a schedule, with a correction of its own, on calls that this was not fitted on.

        Or without one where that is better: fitted on too few calls, a correction does harm.
        """
        return min(self._with_and_without(steps), key=lambda errors: errors.normalised)

    def correction(self, steps: Sequence[int]) -> Correction | None:
        """The correction of a schedule, fitted on all calls; None where the schedule is better without."""
        corrected, plain = self._with_and_without(steps)
        if plain.normalised <= corrected.normalised:
            return None
        return fit_correction(self._task.executor, self.plan(steps), self._task.calls)

    def comparing(self, full_steps: int) -> float:
        """Seconds that ``errors`` of a schedule takes, by those so far; 0 before any."""
        return self._pace * full_steps

    def correcting(self, full_steps: int) -> float:
        """Seconds that ``correction`` of a schedule takes, likewise."""
        share = self._task.calls.count / (self._fitted.count + 2 * self._compared.count)
        return (1 + share) * self.comparing(full_steps)

    def _with_and_without(self, steps: Sequence[int]) -> tuple[Errors, Errors]:
        begun = time.monotonic()
        fitted = fit_correction(self._task.executor, self.plan(steps), self._fitted)
        errors = self._errors(steps, fitted), self._errors(steps, None)
        self._pace = max(self._pace, (time.monotonic() - begun) / len(steps))
        return errors

    def _errors(self, steps: Sequence[int], correction: Correction | None) -> Errors:
        task, calls = self._task, self._compared
        samples = task.executor.corrected(correction).run(self.plan(steps), calls)
        normalised, units = (task.actions.errors(samples, calls.targets, units=u).mean() for u in (False, True))
        return Errors(float(normalised), float(units))

    def crowded(self, full_steps: int, crowding: Sequence[float] = CROWDING) -> list[tuple[int, ...]]:
        """The family of schedules that a search starts with: the different ones of ``full_steps`` steps."""
        return crowded_family(self._task.executor.model.steps, full_steps, crowding)
