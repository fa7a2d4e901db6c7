"""A head in training, as the paper's authors train theirs or as ``tts-paper`` trains ours; see ``at_its_word.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from decoder_head import BASE, FIXED
from dropped import DroppedHead
from gate_gradients import GateGradients
from torch import Tensor

from ttscompile.calibration.calls import Calls, calls_of
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.calibration.task import Found, Task
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.ir.plan_head import first_numbers, has_head
from ttscompile.runtimes.plans import pruner_plan

Array = npt.NDArray[np.float32]

BATCH = 16
"""Calls of an update: as many streams as theirs has episodes."""

FORBIDDEN = -1e9
"""Logit of a source that may not be taken."""

RATES, BETAS, DECAY = (1e-4, 1e-6), (0.9, 0.999), 1e-4
"""Theirs: of AdamW at most and at least, its memories, and how fast weights decay."""

WARM, EPOCHS, FALLING = 4, 20, 45
"""Theirs: epochs until the rate is highest, epochs of the training, and epochs after which it would be lowest."""

OURS_BASE, OURS_OTHERS = 0.005, 0.015
"""Ours: rate of what does not depend on the observation, and of other arrays of the low-rank head by their size."""

SHRINKING, START = 0.3, 2
"""Ours: share of the updates with more computed cells than the budget has, and how many times as many at first."""

FIRST = 2.0, 1.0
"""Ours: logits at first, of COMPUTE at the steps to begin with, and of what the others read."""

EVERY, COMPARED = 100, 64
"""Updates between two comparisons, and calls of other episodes for it."""

REFITTED = 8
"""How often a correction is fitted again while a head is trained with it."""


def rate_of(share: float) -> float:
    """Their rate after this share of the training, times the highest."""
    epoch, least = share * EPOCHS, RATES[1] / RATES[0]
    if epoch < WARM:
        return min(1.0, least + epoch / WARM)
    return 1.0 - (epoch - WARM) / (FALLING - WARM) * (1.0 - least)


@dataclass(frozen=True)
class Recipe:
    """How a head is trained.

    Attributes:
        sources: what cells may read that are not computed.
        paper: whether by the authors' losses and optimiser; else by ours.
        corrected: whether the sampler is corrected while it is trained.
        updates: how many.
        begin: ours: the steps to begin with, more than the budget has.
        detached: ours: whether gates have no part of what later cells read of the caches, as theirs.
        rate: the paper's: times their rates.
        sparse_stream: whether what a cell would have computed is computed where the sparse call was, as theirs is.
    """

    sources: tuple[Source, ...]
    paper: bool
    corrected: bool
    updates: int
    begin: Sequence[int] = (0,)
    detached: bool = False
    rate: float = 1.0
    sparse_stream: bool = False


class Training:
    """A head in training.

    Args:
        task: its calls are windows, and have what the dense policy answers.
        recipe: how.
    """

    def __init__(self, task: Task, recipe: Recipe) -> None:
        self._task, self._recipe = task, recipe
        practised, compared = _divided(task)
        self.compared = task.runner.select(task.calls, compared)
        self._fitted = task.runner.select(task.calls, practised)
        through_caches = not (recipe.paper or recipe.detached)
        sources, beside = recipe.sources, recipe.sparse_stream
        self._practice = GateGradients(task.runner, self._fitted, sources, through_caches, beside)
        self._head: DroppedHead | None = None
        if recipe.paper and not has_head(task.pruner):
            self._head = DroppedHead(task.runner)
        self._cells = task.runner.model.steps * task.runner.model.blocks
        values = _first_values(task, recipe)
        changed = {name for name in values if name != BASE or not recipe.paper or has_head(values)}  # theirs has none
        self._values = {name: torch.from_numpy(value).requires_grad_(name in changed) for name, value in values.items()}
        self._moments = {name: (torch.zeros(value.shape), torch.zeros(value.shape)) for name, value in values.items()}
        self._sizes = {
            name: float(np.sqrt(np.mean(value.astype(np.float64) ** 2))) or 1.0 for name, value in values.items()
        }
        self.correction: Correction | None = None
        self.best: dict[str, Array] = {}
        self.loss, self.done, self.told = float("inf"), 0, list[dict[str, float]]()
        self._latest = float("nan"), float("nan")

    @property
    def first_is_dense(self) -> bool:
        """Whether the first call of a window computes everything."""
        return Source.ROLLOUT in self._recipe.sources

    def plans(self, calls: Calls, values: Mapping[str, npt.NDArray[Any]]) -> PlanArray:
        """What a head with these numbers has N calls compute, ``[N, K, blocks]``."""
        return self.executed(pruner_plan(self._task.runner.logits(calls, values)), calls)

    def executed(self, plans: PlanArray, calls: Calls) -> PlanArray:
        """The same with a dense step 0, and dense first calls."""
        plans[:, 0] = Source.COMPUTE
        if self.first_is_dense:
            plans[:: calls.window] = Source.COMPUTE
        return plans

    def update(self) -> None:
        """One step of the optimiser."""
        task, recipe, practice = self._task, self._recipe, self._practice
        if recipe.corrected and self.done % max(1, recipe.updates // REFITTED) == 0 and self.done:
            self._correct()
        draw = task.draw(self.done, 6)
        window = practice.calls.window if self.first_is_dense else 1
        order = draw.permutation(practice.calls.count // window)[: max(1, BATCH // window)]
        numbers = calls_of(order, window)
        calls = task.runner.select(practice.calls, numbers)
        with torch.autocast("cpu", torch.bfloat16):  # a decoder layer takes half of an update otherwise
            logits = self._logits(calls)
        if not recipe.paper:
            price = torch.zeros(len(Source))
            price[Source.COMPUTE] = price_of(logits.detach().numpy(), self._room())
            logits = logits - price
        told = pruner_plan(logits.detach().numpy())
        told[:, 0] = Source.COMPUTE
        value, gates = practice(self.executed(told.copy(), calls), numbers, self._wrong)
        reused = torch.from_numpy((told != Source.COMPUTE).mean((1, 2)))  # in dense calls, what the head would have
        if recipe.paper:
            sign = torch.sign(reused - (1 - task.budget / self._cells)).float() / (self._cells * calls.count)
            gates[..., 1:] += sign[:, None, None, None]
        gates[:, 0] = 0
        leaves = {name: value for name, value in self._values.items() if value.requires_grad}
        gradients = torch.autograd.grad(logits.softmax(-1), list(leaves.values()), gates, allow_unused=True)
        self._step(dict(zip(leaves, gradients, strict=True)))
        self.done, self._latest = self.done + 1, (value, float(reused.mean()))
        if self.done % EVERY == 0 or self.done == recipe.updates:
            self.compare()

    def _logits(self, calls: Calls) -> Tensor:
        if self._head is not None:
            return self._head(calls.contexts, self._values, self._task.draw(self.done, 8))
        return self._task.runner.model.logits(calls.contexts, self._values).float()

    def _wrong(self, samples: Sequence[Tensor], calls: Calls) -> Tensor:
        """How far sparse calls are from dense ones with the same noise: the chunk; ours also on the way there."""
        if self._recipe.paper:
            return (samples[-1] - calls.targets).abs().mean()
        assert calls.path is not None
        actions = self._task.actions
        wrong = (actions.executed(samples[-1]) - actions.executed(calls.targets)).abs().mean()
        return wrong + (torch.stack(list(samples), 1) - calls.path).abs().mean()

    def _room(self) -> int:
        """Cells that a call may compute now: from more, geometrically, to the budget."""
        left = max(0.0, 1 - (self.done + 1) / max(1.0, SHRINKING * self._recipe.updates))
        return round(float(self._task.budget * START**left))

    def _step(self, gradients: Mapping[str, Tensor | None]) -> None:
        """AdamW of the authors; ours for the arrays of our head, with one size for each."""
        share, (short, long) = self.done / self._recipe.updates, BETAS
        for name, found in gradients.items():
            value = self._values[name]
            gradient = torch.zeros_like(value) if found is None else found.nan_to_num()
            ours = not self._recipe.paper and (name == BASE or has_head(self._values))
            mean, size = self._moments[name]
            mean.mul_(short).add_(gradient, alpha=1 - short)
            size.mul_(short if ours else long).add_(
                (gradient**2).mean() if ours else gradient**2, alpha=1 - (short if ours else long)
            )
            unbiased = 1 - short ** (self.done + 1), 1 - (short if ours else long) ** (self.done + 1)
            step = mean / unbiased[0] / (size / unbiased[1] + (1e-30 if ours else 1e-16)).sqrt()
            with torch.no_grad():
                if ours:
                    rate = OURS_BASE if name == BASE else OURS_OTHERS * self._sizes[name]
                    value -= rate * (1 - share) * step
                else:
                    rate = self._recipe.rate * RATES[0] * rate_of(share)
                    value -= rate * (step + DECAY * value)

    def compare(self) -> None:
        """Hold the head, with the price that keeps the budget, against the best so far."""
        value, reused = self._latest
        runner, calls = self._task.runner.corrected(self.correction), self.compared
        values = self.priced()
        plans = self.plans(calls, values)
        judged = later(calls) if self.first_is_dense else np.arange(calls.count)
        wrong = self._task.actions.errors(runner.run(plans, calls), calls.targets, units=False)[judged]
        error = float(wrong.mean())
        kinds = {source.name: float((plans[judged] == source).mean()) for source in Source}
        self.told.append({"update": self.done, "loss": value, "reused": reused, "error": error, **kinds})
        if error < self.loss:
            self.loss, self.best = error, values

    def priced(self) -> dict[str, Array]:
        """The head with the price of computing with which the calls to compare on keep the budget on average."""
        with torch.no_grad():
            logits = self._task.runner.model.logits(self.compared.contexts, self._values).numpy()
        found = {name: value.detach().numpy().copy() for name, value in self._values.items()}
        found[BASE][1:, :, Source.COMPUTE] -= price_of(logits, self._task.budget)
        return found

    def _correct(self) -> None:
        """Fit the correction to the plans that the head makes now."""
        task, plans = self._task, self.plans(self._fitted, self.priced())
        reads = task.whole.reads(max(1, task.budget // task.runner.model.blocks))  # as those of so many whole steps do
        self.correction = fit_correction(task.runner, plans, self._fitted, reads)
        self._practice.runner = task.runner.corrected(self.correction)
        self.loss, self.best = float("inf"), {}  # errors with another correction say nothing

    def found(self) -> Found:
        """The best head, and its plans frozen: the cells that it computes most often."""
        plans = self.plans(self.compared, self.best)
        often = (plans == Source.COMPUTE).mean(0)
        often[0] = 2
        schedule = np.full(often.shape, Source.TIMESTEP, np.int8)
        schedule.reshape(-1)[np.argsort(-often, axis=None, kind="stable")[: self._task.budget]] = Source.COMPUTE
        notes = {"updates": self.done, "kept_error": self.loss}
        return Found(schedule, notes, pruner={**self._task.pruner, **self.best}, error=self.loss)


def later(calls: Calls) -> npt.NDArray[np.int64]:
    """Numbers of the calls that are not the first of their window."""
    numbers = np.arange(calls.count)
    return numbers[numbers % calls.window > 0] if calls.window > 1 else numbers


def price_of(logits: Array, cells: int) -> float:
    """What COMPUTE has to be ahead by so that calls compute so many cells on average, step 0 included."""
    margins = logits[:, 1:, :, 0] - logits[:, 1:, :, 1:].max(-1)
    ordered = -np.sort(-margins, axis=None)
    count = (cells - logits.shape[2]) * len(logits)
    return float(ordered[count - 1] + ordered[count]) / 2


def _first_values(task: Task, recipe: Recipe) -> dict[str, Array]:
    """What training begins with: the constants that it may change."""
    steps, blocks = task.runner.model.steps, task.runner.model.blocks
    values = {n: np.array(v, np.float32) for n, v in task.pruner.items() if n not in FIXED}
    if has_head(task.pruner):  # an artifact has what the last training left
        (width, inputs), rank = values["pruner.hidden.weight"].shape, values["pruner.step"].shape[1]
        first = first_numbers(inputs, width, rank, steps, blocks)
        values = {n: value for n, value in first.items() if n not in FIXED}
    base = np.zeros((steps, blocks, len(Source)), np.float32)
    reused = recipe.sources[-1] if len(recipe.sources) == 1 else Source.TIMESTEP
    if not recipe.paper:
        base[list(recipe.begin), :, Source.COMPUTE] = FIRST[0]
        base[..., Source.COMPUTE] += 1e-3 * task.draw(0, 5).standard_normal((steps, blocks))
        base[..., reused] = FIRST[1]
    for source in set(Source) - {Source.COMPUTE, *recipe.sources}:
        base[..., source] = FORBIDDEN
    return {**values, BASE: base}


def _divided(task: Task) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Calls to train on, and of other episodes to compare on: whole windows; one serves for both if it is alone."""
    window, calls = task.calls.window, task.calls
    order = task.draw(1, 6).permutation(calls.count // window)
    apart = np.isin(calls.episodes[::window][order], np.unique(calls.episodes)[::4])
    parts = order[~apart], order[apart][: max(1, COMPARED // window)]
    practised, compared = (calls_of(part if len(part) else order[:1], window) for part in parts)
    return practised, compared
