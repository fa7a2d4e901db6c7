"""Learned gates, then frozen: every cell has a score, learned by gradient; the cells with the highest are computed.

- ``dip-go``: cells that are not computed read TIMESTEP, their own last residual. Source: Zhu et al., DiP-GO: A
  Diffusion Pruner via Few-step Gradient Optimization, NeurIPS 2024 (arXiv 2410.16942).
- ``l2c``: the same, and every other step is computed whole, so that no residual is older than one step. Source: Ma et
  al., Learning-to-Cache, NeurIPS 2024 (arXiv 2406.01733).

Both minimise the error of the executed actions plus a sparsity loss, with hard gates whose gradient is passed
straight through, and find the threshold for the target by bisection. Here the threshold is the score of the last cell
that the budget has room for, so the budget is kept throughout, without a weight for the sparsity loss. It begins with
more cells than the budget and shrinks, as the sparsity loss does in the papers.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import numpy.typing as npt

from ttscompile.calibration.task import Array, Found, NothingAfter, Task
from ttscompile.core.lattice import BoolArray, PlanArray, Source, uniform_plan

from .dense import some_calls
from .fixed import COMPARED
from .slopes import slopes

INTERVALS = 120
"""Gradient steps."""

SHRINKING = 0.5
"""Share of the intervals during which there are more computed cells than the budget has."""

START = 0.5
"""Share of all cells that is computed at first."""

BATCH = 6
"""Calls of a gradient step."""

RATE = 0.15
"""Length of a step, where gradients are divided by their running size; the start is a score of 1."""

MEMORY = 0.9
"""Share of the running gradient, and of its running size, that is kept from one step to the next."""


class Gates(NothingAfter):
    """Gradient steps on the scores of the cells; see ``Search``.

    Args:
        reuse: what cells that are not computed read.
        whole: every how many steps all cells are computed; 0 for step 0 only.

    Attributes:
        plan: the best schedule within the budget so far.
    """

    intervals = INTERVALS

    def __init__(self, task: Task, reuse: Source, whole: int = 0) -> None:
        self._task, self._reuse = task, reuse
        model = task.runner.model
        shape = (model.steps, model.blocks)
        self._fixed: BoolArray = np.zeros(shape, np.bool_)
        self._fixed[:: whole or model.steps] = True
        begin = self._fixed | (uniform_plan(*shape, max(1, round(START * model.steps))) == Source.COMPUTE)
        self._scores = begin.astype(np.float64)
        self._mean, self._size = np.zeros(shape), np.zeros(shape)
        self.plan = self._cells(task.budget)
        self.loss = float("nan")

    def advance(self, interval: int) -> None:
        """One gradient step, then the plan of the scores on calls that are always the same."""
        task = self._task
        numbers = task.draw(interval, 0).permutation(task.calls.count)[:BATCH]
        calls = task.runner.select(task.calls, numbers)
        gradient = slopes(task.runner, task.actions, self._cells(self._room(interval)), self._reuse, calls)
        self._step(gradient.astype(np.float64), interval)
        plan = self._cells(task.budget)
        error = task.error(plan, some_calls(task, COMPARED))
        if not error >= self.loss:  # also if nothing was measured before
            self.plan, self.loss = plan, error
        self._interval = interval + 1

    def state(self) -> dict[str, Array]:
        """Scores, what the optimiser remembers, and the best plan."""
        return {
            "plan": self.plan,
            "scores": self._scores,
            "mean": self._mean,
            "size": self._size,
            "loss": np.array(self.loss),
            "interval": np.array(self._interval),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        self.plan = np.array(state["plan"], np.int8)
        self._scores, self._mean, self._size = (np.array(state[name]) for name in ("scores", "mean", "size"))
        self.loss, self._interval = float(state["loss"]), int(state["interval"])

    def found(self) -> Found:
        """The schedule, and no pruner."""
        return Found(self.plan, {"gradient_steps": self._interval})

    def _step(self, gradient: npt.NDArray[np.float64], interval: int) -> None:
        """Adam, with one size for all cells: a cell that hardly matters must not move as far as one that does."""
        self._mean = MEMORY * self._mean + (1 - MEMORY) * gradient
        self._size = MEMORY * self._size + (1 - MEMORY) * (gradient**2).mean()
        unbiased = 1 - MEMORY ** (interval + 1)
        self._scores -= RATE * (self._mean / unbiased) / np.sqrt(self._size / unbiased + 1e-30)

    def _room(self, interval: int) -> int:
        """Computed cells at this interval: from a share of all, geometrically, to the budget."""
        begin = max(int(START * self._scores.size), self._task.budget)
        left = max(0.0, 1 - (interval + 1) / max(1, SHRINKING * self.intervals))
        return round(float(self._task.budget * (begin / self._task.budget) ** left))

    def _cells(self, count: int) -> PlanArray:
        """The plan that computes the ``count`` cells with the highest scores, those that are fixed among them."""
        scores = np.where(self._fixed, np.inf, self._scores).reshape(-1)
        plan = np.full(scores.size, self._reuse, np.int8)
        plan[np.argsort(-scores, kind="stable")[:count]] = Source.COMPUTE
        return plan.reshape(self._fixed.shape)


dip_go = partial(Gates, reuse=Source.TIMESTEP)
l2c = partial(Gates, reuse=Source.TIMESTEP, whole=2)
