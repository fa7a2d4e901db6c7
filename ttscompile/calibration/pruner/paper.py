"""Test-time sparsity as its paper trains it (arXiv 2605.13316): a head decides for each observation, all steps at once.

The head is the artifact's own (``passes.insert_pruner``). Its four logits of every cell are gates: hard in the forward
pass, and in the backward pass those of a softmax (straight-through). Consecutive calls of recorded episodes are run
with the plans that it makes, the rollout cache carried from call to call without gradients. The loss is the mean
absolute error of the executed actions, and of the sample after every step, against the dense policy with the same
noise.

``docs/evidence/ablation.md`` says what differs from the authors' training, and why.

At the end the price is fixed, on calls that the head was not trained on: their mean and two standard errors more are
within the budget. A single call may compute more; the notes say how many cells the largest computes. The schedule that
comes with the head is its plans frozen: the cells that it computes most often.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ...core.coercion import Array, Arrays
from ...core.lattice import PlanArray, Source, whole_steps_plan
from ...ir.plan_head import NAMES, first_numbers, has_head
from ...runtimes.plans import pruner_plan
from ..calls import Calls, IntArray, calls_of
from ..step_counts import spacings
from ..task import Found, NothingAfter, Task
from .straight_through import Practice, legal, written

UPDATES = 240
"""At most, if nothing else is said; an update is an interval."""

BATCH = 16
"""Calls of an update, about: whole windows."""

START = 2.0
"""Times the budget: what is computed at first."""

SHRINKING = 0.3
"""Share of the updates during which more is computed than the budget has."""

FIRST = 2.0, 1.0
"""Logits at first: of COMPUTE at the steps of that schedule, of TIMESTEP everywhere (``reused``). The others are 0."""

APART = 1e-3
"""Deviation of the logits of COMPUTE at first: no two cells are equal."""

RATE = 0.005
"""Of what does not depend on the observation, at first; it falls to 0, evenly from update to update."""

RELATIVE_RATE = 0.015
"""Of the head's other arrays, times their size at first; where that is 0, times 1. It falls likewise."""

MEMORY = 0.9
"""Of the running gradient, and of its running size."""

EVERY = 10
"""Updates after which the head is held against the best so far."""

COMPARED = 64
"""Calls for that, of episodes that it is not trained on, where there are several."""

FORBIDDEN = -1e9
"""Logit of a source that may not be taken."""

BASE = "pruner.base"


class Paper(NothingAfter):
    """The training of this module; see ``Search``.

    Args:
        task: see ``Task``; its calls may be windows of consecutive ones. Without them nothing can be read of an earlier
            call, and without constants of the pruner one plan is trained for all observations.
        sources: what cells may read that are not computed, beside ``reused``: what reads ROLLOUT in the first call of
            an episode reads TIMESTEP instead.
        observes: whether the head reads the observation. Else one plan is trained for all calls.
        begin: the steps from which it departs, within the budget; None for the best of a family, and for more at first.
        updates: at most; None for ``UPDATES``.
        reused: what cells read at first that are not computed.

    Attributes:
        loss: error of the best head so far on calls that it was not trained on, at the budget.
        trained: the same without what it begins with: how far training got, whether or not that is better. Infinite
            before the first comparison.
    """

    intervals = UPDATES

    def __init__(
        self,
        task: Task,
        sources: Collection[Source] = tuple(Source),
        observes: bool = True,
        begin: Sequence[int] | None = None,
        updates: int | None = None,
        reused: Source = Source.TIMESTEP,
    ) -> None:
        if updates is not None:
            self.intervals = updates
        self._task, self._observes = task, observes and has_head(task.pruner)
        self._sources, self._begin, self._reused = sources, begin, reused
        practised, compared = _divided(task)
        self._practised, self._compared = (task.runner.select(task.calls, one) for one in (practised, compared))
        self._practice: Practice | None = None
        model = task.runner.model
        self._most = task.budget if begin is not None else min(round(START * task.budget), model.steps * model.blocks)
        self._values = {BASE: self._base([0])}
        if self._observes:
            self._values |= _first_numbers(task.pruner)
        sizes = {name: float(np.sqrt(np.mean(value.astype(np.float64) ** 2))) for name, value in self._values.items()}
        self._rates = {name: RELATIVE_RATE * (size or 1.0) for name, size in sizes.items()}
        self._rates[BASE] = RATE
        self._mean = {name: np.zeros_like(value) for name, value in self._values.items()}
        self._size = dict.fromkeys(self._values, 0.0)
        self._best, self._interval = dict(self._values), 0
        self.plan, self.loss = whole_steps_plan(model.steps, model.blocks, [0]), float("nan")
        self.trained = float("inf")

    def advance(self, interval: int) -> None:
        """One update; after every few of them, and after the last, the head is held against the best."""
        if self._practice is None:
            self._practice = Practice(self._task.runner, self._practised)
        if interval == 0:
            begin = self._begin
            self._values[BASE] = self._base(self._best_steps(self._task.budget) if begin is None else begin)
            self._compare()  # nothing is kept that is worse than whole steps
            if begin is None:
                self._values[BASE] = self._base(self._best_steps(self._most))
        window = self._practice.calls.window
        order = self._task.draw(interval, 4).permutation(self._practice.calls.count // window)
        self._update(self._practice, calls_of(order[: max(1, BATCH // window)], window), interval)
        self._interval = interval + 1
        if self._interval % EVERY == 0 or self._interval == self.intervals:
            self._compare()

    def state(self) -> dict[str, Array]:
        """The head as it is and at its best, and what the optimiser remembers."""
        state = {"plan": self.plan, "loss": np.array(self.loss), "interval": np.array(self._interval)}
        state["trained"] = np.array(self.trained)
        for name, value in self._values.items():
            state |= {f"now/{name}": value, f"mean/{name}": self._mean[name], f"best/{name}": self._best[name]}
            state[f"size/{name}"] = np.array(self._size[name])
        return state

    def restore(self, state: Arrays) -> None:
        """Go back to where ``state`` was taken."""
        self.plan = np.array(state["plan"], np.int8)
        self.loss, self._interval = float(state["loss"]), int(state["interval"])
        self.trained = float(state["trained"])
        for name in self._values:
            self._values[name], self._mean[name] = np.array(state[f"now/{name}"]), np.array(state[f"mean/{name}"])
            self._best[name], self._size[name] = np.array(state[f"best/{name}"]), float(state[f"size/{name}"])

    def found(self) -> Found:
        """The head at its best, and its plans frozen as a schedule."""
        plans = pruner_plan(self._logits(self._best, self._compared).numpy())
        computed = (plans == Source.COMPUTE).sum((1, 2))
        executed = legal(plans, self._compared.window)
        notes = {
            "updates": self._interval,
            "trained_error": self.trained if np.isfinite(self.trained) else None,
            "kept_error": self.loss,
            "computed_cells": {"mean": float(computed.mean()), "most": int(computed.max())},
            "sources": {source.name: int((executed == source).sum()) for source in Source},
        }
        pruner = {**self._task.pruner, **self._best} if self._observes else None
        return Found(self.plan, notes, pruner=pruner, error=self.loss)

    def _best_steps(self, cells: int) -> Sequence[int]:
        """The schedule of so many cells with the lowest error, as far as there is time to try."""
        task, model = self._task, self._task.runner.model
        family = spacings(model.steps, max(1, min(cells // model.blocks, model.steps)))
        tried = [
            (task.error(whole_steps_plan(model.steps, model.blocks, steps), self._compared), steps)
            for steps in task.clock.in_time(family)
        ]
        return min(tried)[1]

    def _base(self, begin: Sequence[int]) -> Array:
        """What does not depend on the observation, at first, ``[K, blocks, 4]``."""
        model, draw = self._task.runner.model, self._task.draw(0, 5)
        base = np.zeros((model.steps, model.blocks, len(Source)))
        base[list(begin), :, Source.COMPUTE] = FIRST[0]
        base[..., Source.COMPUTE] += APART * draw.standard_normal(base.shape[:2])
        base[..., self._reused] = FIRST[1]
        alone = {Source.ROLLOUT} if self._task.calls.window == 1 else set[Source]()
        for source in set(Source) - {Source.COMPUTE, self._reused} - (set(self._sources) - alone):
            base[..., source] = FORBIDDEN
        return base.astype(np.float32)

    def _logits(self, values: Arrays | Mapping[str, Tensor], calls: Calls) -> Tensor:
        """What the head says, ``[N, K, blocks, 4]``."""
        tensors = {name: torch.as_tensor(value) for name, value in values.items()}
        if self._observes:
            return self._task.runner.model.logits(calls.contexts, tensors)
        return tensors[BASE].expand(calls.count, *tensors[BASE].shape)

    def _update(self, practice: Practice, numbers: IntArray, interval: int) -> None:
        task, calls = self._task, self._task.runner.select(practice.calls, numbers)
        leaves = {name: torch.from_numpy(value.copy()).requires_grad_() for name, value in self._values.items()}
        logits = self._logits(leaves, calls)
        price = torch.zeros(len(Source))
        left = max(0.0, 1 - (interval + 1) / max(1.0, SHRINKING * self.intervals))  # geometrically to the budget
        room = round(float(task.budget * (self._most / task.budget) ** left))
        price[Source.COMPUTE] = _price(logits.detach().numpy(), room)
        logits = logits - price
        plans = legal(pruner_plan(logits.detach().numpy()), calls.window)
        hard = torch.nn.functional.one_hot(torch.from_numpy(plans.astype(np.int64)), len(Source)).float()
        forbidden = np.zeros(hard.shape, np.bool_)
        forbidden[..., Source.ROLLOUT] = ~written(plans, calls.window)
        soft = logits.masked_fill(torch.from_numpy(forbidden), FORBIDDEN).softmax(-1)
        gates = torch.cat([hard[:, :1], (hard + soft - soft.detach())[:, 1:]], 1)
        samples = torch.stack(practice.samples(plans, gates, numbers), 1)
        assert calls.path is not None
        wrong = (task.actions.executed(samples[:, -1]) - task.actions.executed(calls.targets)).abs().mean()
        loss = wrong + (samples - calls.path).abs().mean()
        gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        unbiased = 1 - MEMORY ** (interval + 1)
        for name, found in zip(leaves, gradients, strict=True):
            gradient = np.zeros_like(self._values[name]) if found is None else found.nan_to_num().numpy()
            self._mean[name] = MEMORY * self._mean[name] + (1 - MEMORY) * gradient
            self._size[name] = MEMORY * self._size[name] + (1 - MEMORY) * float((gradient.astype(float) ** 2).mean())
            step = self._mean[name] / unbiased / np.sqrt(self._size[name] / unbiased + 1e-30)
            rate = self._rates[name] * (1 - interval / self.intervals)
            self._values[name] = (self._values[name] - rate * step).astype(np.float32)

    def _compare(self) -> None:
        task, calls, values = self._task, self._compared, self._priced()
        plans = legal(pruner_plan(self._logits(values, calls).numpy()), calls.window)
        error = task.error(plans, calls)
        if self._interval:  # before any update these are whole steps
            self.trained = min(self.trained, error)
        if not error >= self.loss:  # also if nothing was measured before
            self._best, self.loss = values, error
            self.plan = self._frozen()

    def _priced(self) -> dict[str, Array]:
        """The head with the price of a computed cell with which calls that it is not trained on keep the budget."""
        task, logits = self._task, self._logits(self._values, self._compared).numpy()
        blocks, fixed = task.runner.model.blocks, {name: value.copy() for name, value in self._values.items()}
        for cells in range(task.budget, blocks - 1, -1):
            price = _price(logits, cells)
            computed = blocks + (_margins(logits) > price).sum((1, 2))
            if computed.mean() + 2 * computed.std() / len(computed) ** 0.5 <= task.budget:
                break
        fixed[BASE][1:, :, Source.COMPUTE] -= price
        return fixed

    def _frozen(self) -> PlanArray:
        """The best head's plans as one: the cells that it is the most inclined to compute, as the budget has room."""
        logits = self._logits(self._best, self._compared).numpy()
        inclined = _margins(logits).mean(0)
        steps, blocks = self._task.runner.model.steps, self._task.runner.model.blocks
        plan: PlanArray = np.full((steps, blocks), Source.TIMESTEP, np.int8)
        others = logits.mean(0)
        plan[others[..., Source.FORWARD] > others[..., Source.TIMESTEP]] = Source.FORWARD
        plan[0] = Source.COMPUTE
        chosen = np.argsort(-inclined, axis=None, kind="stable")[: self._task.budget - blocks]
        plan[1:].reshape(-1)[chosen] = Source.COMPUTE
        return plan


def _margins(logits: Array) -> Array:
    """By how much COMPUTE is ahead of the other sources after step 0, ``[N, K - 1, blocks]``."""
    return np.asarray(logits[:, 1:, :, 0] - logits[:, 1:, :, 1:].max(-1))


def _price(logits: Array, cells: int) -> float:
    """What COMPUTE has to be ahead by so that calls compute so many cells on average, step 0 included, or fewer."""
    ordered = -np.sort(-_margins(logits), axis=None)
    count = (cells - logits.shape[2]) * len(logits)
    if count >= len(ordered):
        return float(ordered[-1]) - 1 if len(ordered) else 0.0
    return float(ordered[0]) + 1 if count <= 0 else float(ordered[count - 1] + ordered[count]) / 2


def _first_numbers(head: Arrays) -> dict[str, Array]:
    """What the observation goes through, as it was before any calibration: an artifact has what the last one left."""
    (width, inputs), rank = head["pruner.hidden.weight"].shape, head["pruner.step"].shape[1]
    first = first_numbers(inputs, width, rank, *head[BASE].shape[:2])
    return {name: value for name, value in first.items() if name in NAMES - {BASE}}


def _divided(task: Task) -> tuple[IntArray, IntArray]:
    """Numbers of the calls to train on, and of those of other episodes that heads are compared on.

    Where there is one window alone it serves for both.
    """
    window, calls = task.calls.window, task.calls
    order = task.draw(1, 4).permutation(calls.count // window)
    known = np.unique(calls.episodes)
    apart = np.isin(calls.episodes[::window][order], known[:: max(2, min(4, len(known)))])
    if len(known) == 1:
        apart = np.arange(len(order)) < max(len(order) // 4, int(len(order) > 1))
    parts = [order[~apart], order[apart][: max(1, COMPARED // window)]]
    practised, compared = (calls_of(part if len(part) else order[:1], window) for part in parts)
    return practised, compared
