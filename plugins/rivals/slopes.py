"""How the error of a plan responds to computing another cell: a sparse rollout with its gradient, all blocks beside."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.calibration.calls import Actions, Calls, IntArray
from ttscompile.calibration.runner import Runner, last
from ttscompile.core.lattice import PlanArray, Source

BYTES = 2**28
"""Memory for what the blocks compute; gradients and what they need take three to four times as much."""


def chunks(runner: Runner, count: int) -> Iterator[IntArray]:
    """Numbers of ``count`` calls, as many at once as there is memory for."""
    each = 4 * runner.model.steps * sum(math.prod(type_.at(1)) for type_ in runner.types)
    chunk = int(np.clip(BYTES // each, 1, 32))
    return (np.arange(start, min(start + chunk, count)) for start in range(0, count, chunk))


def sensitivity(
    runner: Runner, plan: PlanArray, reuse: Source, calls: Calls, figure: Callable[[Tensor], Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    """Run the plan, and go back from a figure.

    Args:
        plan: ``[K, blocks]`` of COMPUTE and ``reuse``, step 0 dense.
        figure: a number, of the denoised samples ``[N, T, D]``.

    Returns:
        On the CPU, by the number of a cell, ``k * blocks + b``: what its block computes there, or would, for each call
        (``[N, size]``), and the gradient of the figure in what the cell adds (``[N, size]``).
    """
    model = runner.model
    streams = runner.select(calls, np.arange(calls.count))
    cache: dict[int, Tensor] = {}
    computed: list[Tensor] = []
    passed: list[Tensor] = []  # the residual stream after additions: its gradient is that of what was added just before
    position: list[int] = []

    def blocks(k: int, stream: Tensor) -> Tensor:
        row = plan[k]
        computes = bool((row == Source.COMPUTE).any()) or not runner.alike
        for b, axis in enumerate(runner.axes):
            key = model.groups[b] if reuse == Source.FORWARD else b
            if row[b] == Source.COMPUTE:
                cache[key] = model.block(b, k, stream, streams.contexts)
                computed.append(_rows(cache[key].detach(), axis))
            else:
                with torch.no_grad():
                    computed.append(_rows(model.block(b, k, stream, calls.contexts), axis))
            stream = stream + cache[key]
            if computes:
                position.append(len(passed))
                passed.append(stream)
        if not computes:  # nothing but additions: one gradient serves all blocks
            position.extend([len(passed)] * len(row))
            passed.append(stream)
        return stream

    streams.initial.requires_grad_()
    gradients = torch.autograd.grad(figure(last(runner.samples(streams, blocks))), passed)
    axes = runner.axes * model.steps
    return computed, [_rows(gradients[i], axis) for i, axis in zip(position, axes, strict=True)]


def _rows(values: Tensor, axis: int) -> Tensor:
    """One row a stream, on the CPU."""
    return values.movedim(axis, 0).flatten(1).cpu()


Matrix = npt.NDArray[np.float32]


def slopes(runner: Runner, actions: Actions, plan: PlanArray, reuse: Source, calls: Calls) -> Matrix:
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
    for numbers in chunks(runner, calls.count):
        total += _summed(runner, actions, plan, reuse, runner.select(calls, numbers))
    return (total / calls.count).astype(np.float32)


def chains(plan: PlanArray, reuse: Source, groups: tuple[int, ...]) -> list[npt.NDArray[np.int64]]:
    """The cells of each chain, ``k * blocks + b``, in order of execution."""
    cells = np.arange(plan.size).reshape(plan.shape)
    owner = np.asarray(groups) if reuse == Source.FORWARD else np.arange(plan.shape[1])
    return [cells[:, owner == one].reshape(-1) for one in np.unique(owner)]


def _summed(runner: Runner, actions: Actions, plan: PlanArray, reuse: Source, calls: Calls) -> npt.NDArray[np.float64]:
    """The slopes of a few calls, added up: ``[K, blocks]``."""

    def error(samples: Tensor) -> Tensor:
        return (actions.executed(samples) - actions.executed(calls.targets)).abs().mean(-1).sum()

    would, gradients = sensitivity(runner, plan, reuse, calls, error)
    computed, values = (plan == Source.COMPUTE).reshape(-1), np.zeros(plan.size, np.float64)
    for chain in chains(plan, reuse, runner.model.groups):
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
