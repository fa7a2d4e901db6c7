"""Test-time sparsity: computed cells placed by their effect on the executed actions, then moved by the observation.

The search starts from whole steps. An interval linearises the error of some calls around the plan (``linear``), lets
the linear models of the last few intervals propose swaps of cells (``swaps``), measures the true error after one, two,
four ... of them on other calls, and keeps the best if it holds on still others. The budget is kept exactly throughout.
When that stops helping, the schedule is settled, and ``adaptation`` lets the pruner depart from it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ...lattice import PlanArray, Source
from ..adaptation import Adaptation
from ..calls import Calls
from ..crowded import crowded_plans
from ..linear import LinearModel, Matrix, linearise
from ..swaps import propose
from .base import Array, Found, Task

SEARCH = 60
"""Intervals of the search at most."""

PATIENCE = 8
"""Intervals in a row without progress after which it stops."""

LINEARISED, SCREENED, CONFIRMED = 32, 32, 96
"""Calls on which an interval linearises, screens its proposals, and confirms the best; fewer if there are fewer."""

EARLY = 8
"""Intervals that linearise half as many: at first almost every swap helps."""

REMEMBERED = 3
"""Linear models that propose together: this interval's and the ones before."""

SIZES = (1, 2, 3, 4, 6, 8, 12, 16)
"""Numbers of swaps after which the error is measured."""

FINALISTS = 2


class Tts:
    """See the module."""

    closing = Adaptation.INTERVALS
    intervals = SEARCH + closing

    def __init__(self, task: Task) -> None:
        self._task = task
        model = task.executor.model
        self._plan: PlanArray = np.zeros((model.steps, model.blocks), np.int8)
        self._loss = float("nan")
        self._idle = 0
        self._history: list[tuple[int, PlanArray]] = []  # interval and plan of each remembered model
        self._models: list[LinearModel] = []
        self._adaptation: Adaptation | None = None

    @property
    def plan(self) -> PlanArray:
        """The best schedule so far."""
        return self._plan

    @property
    def loss(self) -> float:
        """Error of the plan on the calls of the last interval."""
        return self._loss

    @property
    def done(self) -> bool:
        """Whether the schedule is settled, and the pruner fitted to it."""
        return self._adaptation is not None and self._adaptation.done

    def close(self) -> None:
        """Settle the schedule."""
        if self._adaptation is None:
            self._adaptation = Adaptation(self._task, self._plan)

    def advance(self, interval: int) -> None:
        """Choose where to start, improve the plan once, or adapt it to observations."""
        if self._adaptation is not None:
            self._adaptation.advance()
        elif interval == 0:
            self._start()
        else:
            self._improve(interval)
            if self._idle >= PATIENCE or interval + 1 >= SEARCH:
                self.close()

    def state(self) -> dict[str, Array]:
        """Plan, and what is needed to make the remembered models again."""
        state = {
            "plan": self._plan,
            "loss": np.array(self._loss),
            "idle": np.array(self._idle),
            "remembered": np.array([interval for interval, _ in self._history], np.int64),
            "remembered_plans": np.array([plan for _, plan in self._history], np.int8).reshape(-1, *self._plan.shape),
        }
        return state if self._adaptation is None else {**state, **self._adaptation.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken; linearises again what it remembers."""
        self._loss, self._idle = float(state["loss"]), int(state["idle"])
        self._history, self._models = [], []
        if Adaptation.KEY not in state:
            for interval, plan in zip(state["remembered"], state["remembered_plans"], strict=True):
                self._plan = np.array(plan, np.int8)
                self._remember(int(interval), self._divide(int(interval))[0])
        self._plan = np.array(state["plan"], np.int8)
        if Adaptation.KEY in state:
            self._adaptation = Adaptation(self._task, self._plan)
            self._adaptation.restore(state)

    def found(self) -> Found:
        """The schedule, and the pruner if plans that depend on the observation were better."""
        if self._adaptation is None or self._adaptation.pruner is None:
            return Found(self._plan, None, {"switches": 0})
        return Found(self._plan, self._adaptation.pruner, {"switches": self._adaptation.switches})

    def _start(self) -> None:
        """The best of the crowded whole-step plans."""
        task, calls = self._task, self._divide(0)[0]
        model = task.executor.model
        plans = crowded_plans(model.steps, model.blocks, max(1, task.budget // model.blocks))
        errors = task.actions.errors(task.executor.run(plans, calls), calls.targets, units=False).mean(1)
        best = int(np.argmin(errors))
        self._plan, self._loss = plans[best], float(errors[best])

    def _improve(self, interval: int) -> None:
        """One interval of the search."""
        learned, screened, confirmed = self._divide(interval)
        self._remember(interval, learned)
        proposals = propose(self._models, self._task.budget, SIZES[-1])
        plans = [_plan(proposals[n - 1]) for n in SIZES if n <= len(proposals)]
        self._idle += 1
        if not plans:
            return
        base, first = self._compare(plans, screened)
        best = np.argsort(first.mean(1), kind="stable")[:FINALISTS]
        base_again, again = self._compare([plans[i] for i in best], confirmed)
        change = np.concatenate([first[best], again], 1).mean(1)
        winner = int(np.argmin(change))
        self._loss = float(np.concatenate([base, base_again]).mean())
        if change[winner] < 0 and again[winner].mean() < 0:
            self._plan, self._idle = plans[best[winner]], 0
            self._loss += float(change[winner])

    def _remember(self, interval: int, calls: Calls) -> None:
        """Linearise around the plan; the models of earlier intervals follow to it."""
        for model in self._models:
            model.apply(self._plan == Source.COMPUTE)
        task = self._task
        seed = int(task.draw(interval, 1).integers(2**31))
        model = linearise(task.executor, task.actions, self._plan, calls, seed)
        self._models = [*self._models, model][-REMEMBERED:]
        self._history = [*self._history, (interval, self._plan)][-REMEMBERED:]

    def _divide(self, interval: int) -> tuple[Calls, Calls, Calls]:
        """Calls to learn from, to screen on, and to confirm on; different calls if there are enough."""
        count = self._task.calls.count
        order = self._task.draw(interval, 0).permutation(count)
        learned = min(LINEARISED // 2 if interval < EARLY else LINEARISED, (count + 1) // 2)
        rest = order[learned:] if count > 1 else order
        screened = min(SCREENED, (len(rest) + 1) // 2)
        confirmed = rest[screened : screened + CONFIRMED] if len(rest) > 1 else rest
        select = self._task.executor.selector.calls
        first, second, third = (
            select(self._task.calls, part) for part in (order[:learned], rest[:screened], confirmed)
        )
        return first, second, third

    def _compare(self, plans: list[PlanArray], calls: Calls) -> tuple[Matrix, Matrix]:
        """Error of the plan on each call ``[N]``, and by how much it changes with each of the others ``[C, N]``."""
        samples = self._task.executor.run([self._plan, *plans], calls, base=self._plan)
        errors = self._task.actions.errors(samples, calls.targets, units=False)
        return errors[0], errors[1:] - errors[0]


def _plan(computed: npt.NDArray[np.bool_]) -> PlanArray:
    return np.where(computed, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
