"""What every single cell is worth: the straight-through gradient of all gates of a plan, from one sparse rollout.

A plan that reuses in one direction only is a set of *chains*: cells in order of execution, of which each adds what the
last computed one before it (or itself) computed. For TIMESTEP a chain is a block; for FORWARD it is a group of blocks
of one kind, through all steps. To compute cell i in place of reusing o, until the next computed cell of the chain,
changes the error to first order by::

    sum over i <= j < next(i) of  <dE/dr[j], f[i] - f[o]>

where ``r[j]`` is what cell j adds and ``f[i]`` what its block computes there; ``o`` is the last computed cell before i,
whether i itself is computed or not. That is the gradient of the gate of cell i in ``ReferenceModel.denoise``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..calibration.calls import Actions, Calls
from ..calibration.execute import Executor
from ..core.lattice import PlanArray, Source
from .sensitivity import chunks, sensitivity

Matrix = npt.NDArray[np.float32]


def slopes(executor: Executor, actions: Actions, plan: PlanArray, reuse: Source, calls: Calls) -> Matrix:
    """The slope of the mean error in every COMPUTE gate.

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
