"""How the executed actions respond to any change of a plan, to first order: one sparse rollout and its gradient.

Around the rollout of a plan, the actions change by ``sum over cells of <dA/dr[k, b], change of r[k, b]>``, where ``r``
is what a cell adds. A cell adds the residual that its block computed at its *origin*, the last computed step. So if
the candidates ``f[o, b]``, what block b *would* compute at step o, are known for every cell, and the gradients of the
actions in every ``r``, then so is the effect of every choice of computed steps of a block::

    effect(origins) = sum over k of  <dA/dr[k, b], f[origin(k), b]> - <dA/dr[k, b], f[origin now(k), b]>

exactly for caches (what is computed once is added until the next computation), linearly for everything downstream.
This is the straight-through gradient of all gates at once, but kept per call and per direction in the space of the
actions, so that the squared error of any combination of changes can be predicted, and not its slope alone. On the
Push-T policy the predicted and the measured change of the error by a single cell correlate by 0.95 or better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..calibration.calls import Actions, Calls
from ..calibration.execute import Executor
from ..core.lattice import BoolArray, PlanArray, Source
from .sensitivity import chunks, sensitivity

Matrix = npt.NDArray[np.float32]

DIRECTIONS = 4
"""Random directions of the action space that are followed for each call, in place of all of its dimensions."""

SOFTEN = 0.5
"""Share of the median error that is added where errors are divided by their size."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The linearised error of a set of calls under changes of one plan.

    Attributes:
        reach: float32 ``[blocks, K + 1, K, N * directions]``; ``reach[b, k, o]`` is what the residual of block b
            computed at step o contributes if it is added at all steps before k.
        error: ``[N * directions]``; of ``plan``, weighted and projected. Its square is what the search makes small.
        computed: bool ``[K, blocks]``; the cells that are computed in the plan that ``error`` belongs to.
    """

    reach: Matrix
    error: Matrix
    computed: BoolArray

    def toggles(self) -> Matrix:
        """By how much the error changes if one cell is toggled: ``[K, blocks, N * directions]``."""
        count = len(self.computed)
        effects = np.zeros((*self.computed.shape, len(self.error)), np.float32)
        for b, reach in enumerate(self.reach):
            steps = np.flatnonzero(self.computed[:, b])
            for before, now, after in zip([-1, *steps[:-1]], steps, [*steps[1:], count], strict=True):
                reused = np.arange(now + 1, after)
                added, dropped = reach[after, reused] - reach[reused, reused], reach[after, now] - reach[reused, now]
                effects[reused, b] = added - dropped
                if now > 0:
                    effects[now, b] = reach[after, before] - reach[now, before] - reach[after, now] + reach[now, now]
        return effects


def linearise(executor: Executor, actions: Actions, plan: PlanArray, calls: Calls, seed: int) -> LinearModel:
    """Linearise the error of some calls around a plan of COMPUTE and TIMESTEP.

    Errors are weighted by the inverse of their size in this plan, so that the sum of squares is the sum of absolute
    values near it, and projected on random directions for each call.

    Args:
        executor: runs the policy.
        actions: which part of the sample counts.
        plan: ``[K, blocks]``.
        calls: calls whose targets are known.
        seed: the seed of the directions.
    """
    generator = torch.Generator().manual_seed(seed)
    difference = actions.executed(executor.run(plan, calls)) - actions.executed(calls.targets)
    weights = 1 / (difference.abs() + SOFTEN * difference.abs().median() + 1e-9)
    rank = min(DIRECTIONS, actions.size)
    bases = torch.linalg.qr(torch.randn(calls.count, actions.size, rank, generator=generator))[0]
    probes = bases.transpose(1, 2) * (actions.size / rank) ** 0.5 * weights.sqrt()[:, None]
    reaches = [
        _reach(executor, actions, plan, executor.select(calls, numbers), probes[torch.as_tensor(numbers)])
        for numbers in chunks(executor, calls.count)
    ]
    error = torch.einsum("nra,na->nr", probes, difference).flatten()
    return LinearModel(np.concatenate(reaches, -1), error.numpy(), plan == Source.COMPUTE)


def _reach(executor: Executor, actions: Actions, plan: PlanArray, calls: Calls, probes: Tensor) -> Matrix:
    """``LinearModel.reach`` of a few calls; ``probes`` is ``[N, R, size]``."""
    rank, count, (steps, blocks) = probes.shape[1], calls.count, plan.shape

    def projected(samples: Tensor) -> Tensor:
        return (actions.executed(samples).reshape(rank, count, -1) * probes.transpose(0, 1)).sum()

    computed, gradients = sensitivity(executor, plan, Source.TIMESTEP, calls, rank, projected)
    reach = np.empty((blocks, steps, steps, count * rank), np.float32)
    for b in range(blocks):
        slopes = torch.stack(gradients[b::blocks], 1)
        slopes = slopes.reshape(rank, count, *slopes.shape[1:])
        products = slopes @ torch.stack(computed[b::blocks], 1).transpose(1, 2)  # [R, N, K added, K computed]
        reach[b] = products.permute(2, 3, 1, 0).flatten(2).numpy()
    summed = np.zeros((blocks, steps + 1, *reach.shape[2:]), np.float32)
    np.cumsum(reach, axis=1, out=summed[:, 1:])
    return summed
