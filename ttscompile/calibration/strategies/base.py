"""What a strategy is given, what it gives, and how it can be interrupted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ...core.correction import Correction
from ...core.lattice import PlanArray
from ...runtimes.criterion import Criterion
from ..calls import Actions, Calls
from ..clock import Clock
from ..execute import Executor

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Task:
    """What to find a plan for.

    Attributes:
        executor: runs plans.
        actions: which part of the sample counts.
        calls: to learn from, with targets; never those that the plan is judged on.
        budget: cells that a plan may compute, step 0 included.
        seed: of all that is random.
        pruner: constants of the pruner by name; empty if the artifact has none.
        kinds: what each block is.
        clock: what can be left out is not begun if it would end after its limit.
    """

    executor: Executor
    actions: Actions
    calls: Calls
    budget: int
    seed: int
    pruner: Mapping[str, Array]
    kinds: tuple[str, ...]
    clock: Clock = field(default_factory=Clock)

    def draw(self, *stage: int) -> np.random.Generator:
        """Random numbers that belong to a stage, whatever was drawn before: so that going on equals not stopping."""
        return np.random.default_rng((self.seed, 3, *stage))

    def some_calls(self, count: int) -> Calls:
        """Some of the calls to learn from, always the same ones; all if there are fewer."""
        return self.executor.selector.calls(self.calls, self.draw(0).permutation(self.calls.count)[:count])

    def error(self, plan: PlanArray, calls: Calls) -> float:
        """Mean error of the executed actions of a plan on some calls, normalised; see ``Executor.run``."""
        return float(self.actions.errors(self.executor.run(plan, calls), calls.targets, units=False).mean())


@dataclass(frozen=True)
class Found:
    """The outcome of a strategy.

    Attributes:
        schedule: int8 ``[K, blocks]``, within the budget.
        pruner: all constants of the pruner, by name, for plans that depend on the observation; None for none.
        notes: what is worth keeping about how it was found; JSON.
        correction: of the sampler's steps, for the schedule and the pruner's plans; None for none.
        criterion: decides the plan during the call; ``schedule`` is then one of its decisions. None for none.
    """

    schedule: PlanArray
    pruner: Mapping[str, Array] | None
    notes: Mapping[str, Any]
    correction: Correction | None = None
    criterion: Criterion | None = None


class Strategy(Protocol):
    """A search in intervals. What it knows between two of them is ``state``: it can be stopped there and go on later.

    Attributes:
        intervals: how many there are at most.
        closing: how many are still to be done after ``close``.
    """

    intervals: int
    closing: int

    @property
    def settling(self) -> float:
        """Seconds that ``found`` takes, about."""

    def advance(self, interval: int) -> None:
        """Do interval number ``interval``, of ``intervals``; they are done in order."""

    def close(self) -> None:
        """The time is running out: do what is still to be done at the end, and be done."""

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

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken.

        Raises:
            KeyError: not the state of this strategy.
        """

    def found(self) -> Found:
        """The outcome."""
