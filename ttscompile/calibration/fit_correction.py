"""Fit the correction of a schedule: least squares, step by step, on calls whose dense path is known.

At step k the sparse loop, corrected so far, has features; the correction of the step is the ridge regression, on these,
of what is missing to the sample that the dense policy has after the step with the same noise. Then all calls go on
with it. So every step is fitted where the loop will be when it gets there, and what one step leaves over the next can
still repair. One pass of sparse calls: seconds.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..core.correction import Correction, groups_of
from ..core.lattice import BoolArray, PlanArray, Source
from ..runtimes.reference.sampler import correct, features
from .calls import Calls
from .execute import Executor, State, workers

STREAMS = 64
"""Calls that go through the loop at once."""

RIDGE = 1e-4
"""Times the mean square of a feature, for each call."""

ANCHOR_SHARE = 0.5
"""Of the blocks that a step computes, from which on it is an anchor."""


def anchors_of(plan: PlanArray) -> BoolArray:
    """Steps of a plan ``[K, blocks]`` that compute at least half of their blocks, ``[K]``."""
    return np.asarray((plan == Source.COMPUTE).mean(axis=1) >= ANCHOR_SHARE)


def fit_correction(executor: Executor, plan: PlanArray, calls: Calls) -> Correction:
    """The correction of a schedule ``[K, blocks]`` that reads no rollout cache; that of the executor is not used."""
    assert calls.path is not None
    steps, sample = executor.model.steps, (calls.initial.shape[1], calls.initial.shape[2])
    anchors, groups = anchors_of(plan), groups_of(steps, sample)
    parts = [np.arange(i, min(i + STREAMS, calls.count)) for i in range(0, calls.count, STREAMS)]
    lanes = [_Lane(executor, plan, executor.select(calls, part)) for part in parts]
    weights, biases = [], []
    with workers() as pool:
        for k in range(steps):
            pairs = list(pool.map(partial(_Lane.predict, k=k), lanes))
            read, missing = torch.cat([a for a, _ in pairs], 1), torch.cat([b for _, b in pairs], 1)
            weight, bias = _solve(read.double(), missing.double(), groups)
            for lane in lanes:
                lane.advance(weight, bias, bool(anchors[k]))
            weights.append(weight.numpy())
            biases.append(bias.numpy())
    return Correction(anchors, np.stack(weights), np.stack(biases))


class _Lane:
    """Some of the calls on their way through the sparse loop."""

    def __init__(self, executor: Executor, plan: PlanArray, calls: Calls) -> None:
        assert calls.path is not None
        self._executor, self._plan, self._calls, self._path = executor, plan, calls, calls.path
        self._state = State()
        self._carried = self._following = executor.model.sampler.begin(calls.initial)
        self._prediction = calls.initial

    def predict(self, k: int) -> tuple[Tensor, Tensor]:
        """Features of step k, ``[D, n, 6 T]``, and what is missing after it without a correction, ``[D, n, T]``."""
        model, calls = self._executor.model, self._calls

        def blocks(k: int, stem: Tensor) -> Tensor:
            return self._executor.step(self._plan[k][None], k, stem, calls, self._state)

        self._prediction = model.predict(self._carried.sample, k, calls.contexts, blocks)
        noise = None if calls.noise is None else calls.noise[k]
        self._following = model.sampler.advance(self._carried, self._prediction, noise, k)
        missing = (self._path[:, k] - self._following.sample).permute(2, 0, 1)
        return features(self._carried, self._prediction), missing

    def advance(self, weight: Tensor, bias: Tensor, anchor: bool) -> None:
        """Go on with the correction of the step."""
        self._carried = correct(self._carried, self._prediction, self._following, weight, bias, anchor)


def _solve(read: Tensor, missing: Tensor, groups: int) -> tuple[Tensor, Tensor]:
    """Ridge regression of each group with a bias: float32 ``[G, 6 T, T]`` and ``[G, 1, T]``."""
    if groups == 1:
        read, missing = read.flatten(0, 1)[None], missing.flatten(0, 1)[None]
    mean, offset = read.mean(1, keepdim=True), missing.mean(1, keepdim=True)
    read, missing = read - mean, missing - offset
    gram = read.transpose(1, 2) @ read
    scale = gram.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    shift = (RIDGE * scale + 1e-9) * torch.eye(read.shape[-1], dtype=read.dtype)
    weight = torch.linalg.solve(gram + shift, read.transpose(1, 2) @ missing)
    return weight.float(), (offset - mean @ weight).float()
