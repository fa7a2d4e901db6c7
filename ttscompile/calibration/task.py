"""What a search is given (``Task``), how it is interrupted (``Search``), and what it gives (``Found``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from ..core.coercion import Array as Array, Arrays
from ..core.correction import Correction
from ..core.lattice import PlanArray, Source
from ..errors import CalibrationError
from ..pool import Pool
from ..runtimes.plans import pruner_plan
from .calls import Actions, Calls
from .clock import Clock
from .runner import Runner
from .whole_steps import WholeSteps


@dataclass(frozen=True)
class Found:
    """The outcome of a search.

    Attributes:
        schedule: int8 ``[K, blocks]``, within the budget.
        notes: what is worth keeping about how it was found; JSON.
        correction: of the sampler's steps, for the schedule; None for none.
        pruner: all constants of the pruner, by name, for plans that depend on the observation; None for none.
        pruner_correction: of the sampler's steps, for the pruner's plans; None for none.
        error: of the schedule on calls to learn from, normalised; NaN where it was not measured.
    """

    schedule: PlanArray
    notes: Mapping[str, Any] = field(default_factory=dict)
    correction: Correction | None = None
    pruner: Arrays | None = None
    pruner_correction: Correction | None = None
    error: float = math.nan


@dataclass(frozen=True)
class Task:
    """What to find a plan for.

    Attributes:
        calls: to learn from, with targets; never those that the plan is judged on.
        budget: cells that a plan may compute, step 0 included.
        pruner: constants of the pruner by name; empty if the artifact has none.
        whole: compares schedules of whole steps on ``calls``.
        clock: what can be left out is not begun if it would end after its limit.
    """

    runner: Runner
    actions: Actions
    calls: Calls
    budget: int
    seed: int
    pruner: Arrays
    whole: WholeSteps
    clock: Clock = field(default_factory=Clock)

    @classmethod
    def of(
        cls, runner: Runner, calls: Calls, budget: int, seed: int, pool: Pool | None = None, *, small: bool = False
    ) -> Task:
        """The task; ``pool`` and ``small`` are those of ``WholeSteps``, and a budget of 0 is one to be known later."""
        actions, whole = Actions(runner.view.manifest.spec), WholeSteps(runner, calls, seed, pool, small)
        return cls(runner, actions, calls, budget, seed, runner.view.pruner, whole)

    def draw(self, *stage: int) -> np.random.Generator:
        """Random numbers that belong to a stage, whatever was drawn before: so that going on equals not stopping."""
        return np.random.default_rng((self.seed, 3, *stage))

    def error(self, plan: PlanArray, calls: Calls) -> float:
        """Mean error of the executed actions of a plan on some calls, normalised; see ``Runner.run``."""
        return float(self.actions.errors(self.runner.run(plan, calls), calls.targets, units=False).mean())

    def whole_steps(self, steps: Sequence[int], **notes: Any) -> Found:
        """The schedule that computes these steps, with its correction.

        The notes get the steps, how many numbers of the condition the correction reads, and how many jumps it has.
        """
        plan = self.whole.plan(steps)
        correction = self.whole.correction_of(plan)
        return Found(plan, {"steps": list(steps), **_of_correction(correction), **notes}, correction)

    def corrected(self, found: Found) -> Found:
        """What a search found, with corrections where they are better: of the schedule, and of the pruner's plans.

        The pruner's plans share one correction, fitted along the plan that each call has.

        Raises:
            CalibrationError: the schedule reads the rollout cache, and the calls are independent of each other.
        """
        if self.calls.window == 1 and (found.schedule == Source.ROLLOUT.value).any():
            raise CalibrationError(
                "a correction is fitted to a schedule on calls of their own; this one reads residuals of earlier calls."
                " Leave correct out, or take another proposer."
            )
        correction = self.whole.correction_of(found.schedule)
        notes = {**found.notes, "corrected": correction is not None, **_of_correction(correction)}
        if (weights := found.pruner) is None:
            return replace(found, correction=correction, notes=notes)
        own = self.whole.correction_of(lambda calls: pruner_plan(self.runner.logits(calls, weights)))
        notes["pruner_corrected"] = own is not None
        return replace(found, correction=correction, pruner_correction=own, notes=notes)


def _of_correction(correction: Correction | None) -> dict[str, int]:
    own = (0, 0, 0) if correction is None else (correction.reads, len(correction.jumps), correction.of(1).prefixes)
    return dict(zip(("numbers_read_of_the_observation", "jumps", "prefixes"), own, strict=True))


class Search(Protocol):
    """Looks for a schedule, in at most ``intervals``. Between two it can stop, and go on later from its ``state``."""

    intervals: int

    @property
    def seconds_to_finish(self) -> float:
        """Seconds that ``found`` takes, about."""

    def advance(self, interval: int) -> None:
        """Do interval number ``interval``, of ``intervals``; they are done in order."""

    @property
    def done(self) -> bool:
        """Whether further intervals would change nothing."""

    @property
    def loss(self) -> float:
        """Error of the best plan so far, normalised; NaN before any."""

    @property
    def plan(self) -> PlanArray:
        """The best schedule so far."""

    def state(self) -> dict[str, Array]:
        """Everything that ``restore`` needs."""

    def restore(self, state: Arrays) -> None:
        """Go back to where ``state`` was taken. Raises KeyError: not the state of this search."""

    def found(self) -> Found:
        """The outcome."""


class NothingAfter:
    """What a ``Search`` says that has nothing left to do after its intervals: it keeps its best plan throughout."""

    intervals = 1
    seconds_to_finish = 0.0
    _interval = 0  # how many were done

    @property
    def done(self) -> bool:
        """Whether all intervals were done."""
        return self._interval >= self.intervals
