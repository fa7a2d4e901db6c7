"""How actions respond to what each cell of a plan adds: one sparse rollout with its gradient, and all blocks beside it.

``slopes`` and ``linearise`` predict from this what another plan would do, without running it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..calibration.calls import Actions, Calls, IntArray
from ..calibration.execute import Executor, last
from ..core.lattice import BoolArray, PlanArray, Source

BYTES = 2**28
"""Memory for what the blocks compute; gradients and what they need take three to four times as much."""


def chunks(executor: Executor, count: int) -> Iterator[IntArray]:
    """Numbers of ``count`` calls, as many at once as there is memory for."""
    each = 4 * executor.model.steps * sum(math.prod(type_.at(1)) for type_ in executor.types)
    chunk = int(np.clip(BYTES // each, 1, 32))
    return (np.arange(start, min(start + chunk, count)) for start in range(0, count, chunk))


def sensitivity(
    executor: Executor, plan: PlanArray, reuse: Source, calls: Calls, copies: int, figure: Callable[[Tensor], Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    """Run the plan, and go back from a figure.

    Args:
        plan: ``[K, blocks]`` of COMPUTE and ``reuse``, step 0 dense.
        copies: how many streams there are of each call, one after the other: ``[copies * N]``.
        figure: a number, of the denoised samples ``[copies * N, T, D]``.

    Returns:
        On the CPU, by the number of a cell, ``k * blocks + b``: what its block computes there, or would, for each call
        (``[N, size]``), and the gradient of the figure in what the cell adds, for each stream (``[copies * N, size]``).
    """
    model, count = executor.model, calls.count
    streams = executor.select(calls, np.tile(np.arange(count), copies))
    cache: dict[int, Tensor] = {}
    computed: list[Tensor] = []
    passed: list[Tensor] = []  # the stream after additions: its gradient is that of what was added just before
    position: list[int] = []

    def blocks(k: int, stream: Tensor) -> Tensor:
        row = plan[k]
        computes = bool((row == Source.COMPUTE).any()) or not executor.alike
        for b, axis in enumerate(executor.axes):
            key = model.groups[b] if reuse == Source.FORWARD else b
            if row[b] == Source.COMPUTE:
                cache[key] = model.block(b, k, stream, streams.contexts)
                computed.append(_rows(cache[key].detach(), axis)[:count])
            else:
                with torch.no_grad():
                    first = stream.narrow(axis, 0, count)
                    computed.append(_rows(model.block(b, k, first, calls.contexts), axis))
            stream = stream + cache[key]
            if computes:
                position.append(len(passed))
                passed.append(stream)
        if not computes:  # nothing but additions: one gradient serves all blocks
            position.extend([len(passed)] * len(row))
            passed.append(stream)
        return stream

    streams.initial.requires_grad_()
    gradients = torch.autograd.grad(figure(last(executor.samples(streams, blocks))), passed)
    axes = executor.axes * model.steps
    return computed, [_rows(gradients[i], axis) for i, axis in zip(position, axes, strict=True)]


def _rows(values: Tensor, axis: int) -> Tensor:
    """One row a stream, on the CPU."""
    return values.movedim(axis, 0).flatten(1).cpu()


Matrix = npt.NDArray[np.float32]


def slopes(executor: Executor, actions: Actions, plan: PlanArray, reuse: Source, calls: Calls) -> Matrix:
    """The slope of the mean error in every COMPUTE gate: straight through, from one sparse rollout.

    A plan that reuses in one direction only is a set of *chains*: cells in order of execution, of which each adds what
    the last computed one before it (or itself) computed. For TIMESTEP a chain is a block; for FORWARD it is a group of
    blocks of one kind, through all steps. To compute cell i in place of reusing o, until the next computed cell of the
    chain, changes the error to first order by::

        sum over i <= j < next(i) of  <dE/dr[j], f[i] - f[o]>

    where ``r[j]`` is what cell j adds and ``f[i]`` what its block computes there; ``o`` is the last computed cell
    before i, whether i itself is computed or not. That is the gradient of the gate of cell i in
    ``ReferenceModel.denoise``.

    Returns:
        ``[K, blocks]``: by how much computing the cell, rather than reusing, changes the mean absolute error of the
        executed actions, normalised. 0 in step 0, which is always computed.
    """
    total = np.zeros(plan.shape, np.float64)
    for numbers in chunks(executor, calls.count):
        total += _summed(executor, actions, plan, reuse, executor.select(calls, numbers))
    return (total / calls.count).astype(np.float32)


def chains(plan: PlanArray, reuse: Source, groups: tuple[int, ...]) -> list[npt.NDArray[np.int64]]:
    """The cells of each chain, ``k * blocks + b``, in order of execution."""
    cells = np.arange(plan.size).reshape(plan.shape)
    owner = np.asarray(groups) if reuse == Source.FORWARD else np.arange(plan.shape[1])
    return [cells[:, owner == one].reshape(-1) for one in np.unique(owner)]


def _summed(
    executor: Executor, actions: Actions, plan: PlanArray, reuse: Source, calls: Calls
) -> npt.NDArray[np.float64]:
    """The slopes of a few calls, added up: ``[K, blocks]``."""

    def error(samples: Tensor) -> Tensor:
        return (actions.executed(samples) - actions.executed(calls.targets)).abs().mean(-1).sum()

    would, gradients = sensitivity(executor, plan, reuse, calls, 1, error)
    computed, values = (plan == Source.COMPUTE).reshape(-1), np.zeros(plan.size, np.float64)
    for chain in chains(plan, reuse, executor.model.groups):
        f = torch.stack([would[i] for i in chain])  # [cells, N, size]
        until = torch.cumsum(torch.stack([gradients[i] for i in chain]), 0)
        until = torch.cat([torch.zeros_like(until[:1]), until])
        places = np.flatnonzero(computed[chain])
        number = np.searchsorted(places, np.arange(len(chain)))  # of the first computed cell not before
        before = torch.from_numpy(places[np.maximum(number - 1, 0)])
        after = torch.from_numpy(np.append(places, len(chain))[np.searchsorted(places, np.arange(len(chain)), "right")])
        value = ((until[after] - until[:-1]) * (f - f[before])).sum((1, 2))
        values[chain] = value.double().numpy()
    summed = values.reshape(plan.shape)
    summed[0] = 0
    return summed


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

    Around the rollout of a plan, the actions change by ``sum over cells of <dA/dr[k, b], change of r[k, b]>``, where
    ``r`` is what a cell adds. A cell adds the residual that its block computed at its *origin*, the last computed step.
    So if the candidates ``f[o, b]``, what block b *would* compute at step o, are known for every cell, and the
    gradients of the actions in every ``r``, then so is the effect of every choice of computed steps of a block::

        effect(origins) = sum over k of  <dA/dr[k, b], f[origin(k), b]> - <dA/dr[k, b], f[origin now(k), b]>

    exactly for caches (what is computed once is added until the next computation), linearly for everything downstream.
    This is the straight-through gradient of all gates at once, but kept per call and per direction in the space of the
    actions, so that the squared error of any combination of changes can be predicted, and not its slope alone. On the
    Push-T policy the predicted and the measured change of the error by a single cell correlate by 0.95 or better.

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
