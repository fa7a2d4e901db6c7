"""Fit the correction of a schedule: least squares, step by step, on calls whose dense path is known.

At step k the sparse loop, corrected so far, has features; the correction of the step is the ridge regression, on these
and on the principal components of the condition, of what is missing to the sample that the dense policy has after the
step with the same noise. Then all calls go on with it. So every step is fitted where the loop will be when it gets
there, and what one step leaves over the next can still repair. One pass of sparse calls: seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.correction import Correction, components_of, groups_of, numbers_of
from ..core.lattice import BoolArray, PlanArray, Source
from ..core.spec import FloatArray
from ..runtimes.reference.sampler import correct, features
from .calls import Calls
from .execute import Executor, State, workers

STREAMS = 64
"""Calls that go through the loop at once."""

RIDGE = 1e-4
"""Times the mean square of a feature, for each call. That of a component of the condition is 1."""

ROWS = 512
"""Calls whose conditions give the directions of the components, at most."""

SMALLEST = 1e-4
"""A component is mostly rounding, and not read, if its deviation is below this share of the largest one, or of a tenth
of the mean."""

ANCHOR_SHARE = 0.5
"""Of the blocks that a step computes, from which on it is an anchor."""


def anchors_of(plan: PlanArray) -> BoolArray:
    """Steps of a plan ``[K, blocks]``, or on average of plans ``[N, K, blocks]``, that compute half of their blocks."""
    computed = (plan == Source.COMPUTE).reshape(-1, *plan.shape[-2:])
    return np.asarray(computed.mean(axis=(0, 2)) >= ANCHOR_SHARE)


def fit_correction(executor: Executor, plan: PlanArray, calls: Calls, reads: bool) -> Correction:
    """The correction of a schedule, or one for all plans of a pruner.

    Args:
        executor: runs the policy; its own correction is not used.
        plan: ``[K, blocks]``, or ``[N, K, blocks]`` for each call one of its own. It may read the rollout cache where
            the calls are windows.
        calls: to fit it on, with their dense paths.
        reads: whether it may read the observation.
    """
    assert calls.path is not None
    steps, sample = executor.model.steps, (calls.initial.shape[1], calls.initial.shape[2])
    anchors, groups = anchors_of(plan), groups_of(steps, sample)
    condition = executor.model.condition(calls.contexts)
    most = components_of(steps, sample, numbers_of([tuple(condition.shape[1:])])) if reads else 0
    components = _Components.of(condition, most)
    size = max(1, STREAMS // calls.window) * calls.window
    parts = [np.arange(i, min(i + size, calls.count)) for i in range(0, calls.count, size)]
    plans = plan.reshape(-1, *plan.shape[-2:])
    lanes = [_Lane(executor, plans if len(plans) == 1 else plans[part], executor.select(calls, part)) for part in parts]
    solved = []
    with workers() as pool:
        for k in range(steps):
            pairs = list(pool.map(partial(_Lane.predict, k=k), lanes))
            read, missing = torch.cat([a for a, _ in pairs], 1), torch.cat([b for _, b in pairs], 1)
            solved.append(_solve(read.double(), components.values, missing.double(), groups))
            added = solved[-1].bias + torch.einsum("nf,fdt->dnt", components.values.float(), solved[-1].observed)
            for lane, part in zip(lanes, parts, strict=True):
                lane.advance(solved[-1].weight, added[:, part], bool(anchors[k]))
    weights, biases, observed = (np.stack([each.numpy() for each in column]) for column in zip(*solved, strict=True))
    observed = np.ascontiguousarray(observed.transpose(1, 0, 2, 3))
    biases = biases - np.einsum("f,fkdt->kdt", components.center, observed)[:, :, None]
    return Correction(anchors, weights, biases.astype(np.float32), components.reading, observed)


@dataclass(frozen=True)
class _Components:
    """Principal components of the condition of some calls.

    Attributes:
        reading: ``[N, F]``, from the condition to them.
        center: ``[F]``, their mean over the calls, which ``values`` are without.
        values: ``[n, F]``, float64, of mean square 1.
    """

    reading: FloatArray
    center: FloatArray
    values: Tensor

    @classmethod
    def of(cls, condition: Tensor, most: int) -> _Components:
        """The largest ones of ``[n, N]``, as many at most."""
        rows = condition[:, : condition.shape[1] if most else 0].double()
        mean, some = rows.mean(0), rows[:: -(-len(rows) // ROWS)]
        _, lengths, directions = torch.linalg.svd(some - mean, full_matrices=False)
        deviations = lengths / len(some) ** 0.5
        floor = SMALLEST * max(float(deviations.max()) if most else 0.0, 0.1 * float(mean.norm()), 1e-6)
        count = min(most, int((deviations > floor).sum()))
        reading = (directions[:count] / deviations[:count, None]).T.float()
        center = mean @ reading.double()
        return cls(reading.numpy(), center.float().numpy(), rows @ reading.double() - center)


class _Lane:
    """Some of the calls on their way through the sparse loop; ``plans`` is ``[n, K, blocks]``, or of one for all."""

    def __init__(self, executor: Executor, plans: PlanArray, calls: Calls) -> None:
        assert calls.path is not None
        self._executor, self._plans, self._calls, self._path = executor, plans, calls, calls.path
        self._state = State()
        self._carried = self._following = executor.model.sampler.begin(calls.initial)
        self._prediction = calls.initial

    def predict(self, k: int) -> tuple[Tensor, Tensor]:
        """Features of step k, ``[D, n, 6 T]``, and what is missing after it without a correction, ``[D, n, T]``."""
        model, calls = self._executor.model, self._calls

        def blocks(k: int, stem: Tensor) -> Tensor:
            return self._executor.step(self._plans[:, k], k, stem, calls, self._state)

        self._prediction = model.predict(self._carried.sample, k, calls.contexts, blocks)
        noise = None if calls.noise is None else calls.noise[k]
        self._following = model.sampler.advance(self._carried, self._prediction, noise, k)
        missing = (self._path[:, k] - self._following.sample).permute(2, 0, 1)
        return features(self._carried, self._prediction), missing

    def advance(self, weight: Tensor, added: Tensor, anchor: bool) -> None:
        """Go on with the correction of the step: weights ``[G, 6 T, T]``, and what is added beside, ``[D, n, T]``."""
        self._carried = correct(self._carried, self._prediction, self._following, weight, added, anchor)


class _Solved(NamedTuple):
    """The correction of one step.

    Attributes:
        weight: ``[G, 6 T, T]``.
        bias: ``[D, 1, T]``.
        observed: of components, ``[F, D, T]``.
    """

    weight: Tensor
    bias: Tensor
    observed: Tensor


def _solve(read: Tensor, components: Tensor, missing: Tensor, groups: int) -> _Solved:
    """Ridge regression with a bias, of each action dimension on features and components; float32.

    For given weights of the features the best ones of the components are known, so the former are the regression on
    what the components leave over.

    Args:
        read: features ``[D, n, 6 T]``.
        components: ``[n, F]``, of mean 0.
        missing: ``[D, n, T]``.
        groups: D, or 1 where all dimensions share the weights of features.
    """
    mean, offset = read.mean(1, keepdim=True), missing.mean(1, keepdim=True)
    features, targets = read - mean, missing - offset
    calls, width = features.shape[1:]
    own = components.T @ components + RIDGE * calls * torch.eye(components.shape[1], dtype=components.dtype)
    seen, wanted = components.T @ features, components.T @ targets
    gram = features.transpose(1, 2) @ features
    scale = gram.diagonal(dim1=1, dim2=2).reshape(groups, -1, width).sum(1).mean(1)[:, None, None]
    gram = gram - seen.transpose(1, 2) @ torch.linalg.solve(own, seen)
    product = features.transpose(1, 2) @ targets - seen.transpose(1, 2) @ torch.linalg.solve(own, wanted)
    if groups == 1:
        gram, product = gram.sum(0, keepdim=True), product.sum(0, keepdim=True)
    weight = torch.linalg.solve(gram + (RIDGE * scale + 1e-9) * torch.eye(width, dtype=gram.dtype), product)
    observed = torch.linalg.solve(own, wanted - seen @ weight)
    return _Solved(weight.float(), (offset - mean @ weight).float(), observed.transpose(0, 1).float())
