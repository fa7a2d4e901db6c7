"""What corrections are fitted with: a regression for each step, and a small network for each jump.

The regression is on features of the loop, and on components of the condition. The network learns what the steps between
two anchors leave over, where it holds on other episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.correction import HIDDEN
from ..core.envelope import Envelope
from ..core.spec import FloatArray
from ..runtimes.reference.sampler import through
from .calls import IntArray

RIDGE = 1e-4
"""Times the mean square of a feature, for each call. That of a component of the condition is 1."""

ROWS = 512
"""Calls whose conditions give the directions of the components, at most."""

SMALLEST = 1e-4
"""A component is mostly rounding, and not read, if its deviation is below this share of the largest one, or of a tenth
of the mean."""


@dataclass(frozen=True)
class Components:
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
    def of(cls, condition: Tensor, most: int) -> Components:
        """Those of conditions ``[n, N]`` with the largest deviations, so many of them at most."""
        rows = condition[:, : condition.shape[1] if most else 0].double()
        mean, some = rows.mean(0), rows[:: -(-len(rows) // ROWS)]
        _, lengths, directions = torch.linalg.svd(some - mean, full_matrices=False)
        deviations = lengths / len(some) ** 0.5
        floor = SMALLEST * max(float(deviations.max()) if most else 0.0, 0.1 * float(mean.norm()), 1e-6)
        count = min(most, int((deviations > floor).sum()))
        reading = (directions[:count] / deviations[:count, None]).T.float()
        center = mean @ reading.double()
        return cls(reading.numpy(), center.float().numpy(), rows @ reading.double() - center)

    def of_others(self, condition: Tensor) -> Tensor:
        """Those of other calls, ``[n, F]``, from their condition ``[n, N]``."""
        reading = torch.from_numpy(self.reading).double()
        return condition[:, : len(reading)].double() @ reading - torch.from_numpy(self.center).double()


def envelope_of(condition: Tensor, episodes: IntArray, most: int) -> Envelope | None:
    """What was recorded, of the conditions of some calls; None where they say nothing.

    Components are those of every other episode, and the furthest call is that of any: with few calls, others are far
    from the components of these, and nobody could say how far is too far.

    Args:
        condition: ``[n, N]``.
        episodes: of each call, ``[n]``.
        most: components at most.
    """
    _, which = np.unique(episodes, return_inverse=True)
    own = Components.of(condition[torch.from_numpy(which % 2 == 0)], most)
    furthest = float(own.of_others(condition).norm(dim=1).max())
    if not own.reading.shape[1] or not furthest > 0:
        return None
    return Envelope(own.reading / np.float32(furthest), own.center / np.float32(furthest))


class Solved(NamedTuple):
    """The correction of one step.

    Attributes:
        weight: ``[G, 6 T, T]``.
        bias: ``[D, 1, T]``.
        observed: of components, ``[F, D, T]``.
    """

    weight: Tensor
    bias: Tensor
    observed: Tensor


def solve(read: Tensor, components: Tensor, missing: Tensor, groups: int) -> Solved:
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
    return Solved(weight.float(), (offset - mean @ weight).float(), observed.transpose(0, 1).float())


EPOCHS, BATCH = 60, 256
"""Passes over the calls, and calls an update: after twice as many it is no better."""

RATE, DECAY = 2e-3, 0.3
"""The largest step of AdamW, which grows to that in the first third of the updates and falls to zero in the others; and
the decay of the weights."""

FOLDS = 4
"""Parts of the episodes; each call is judged by a network that was fitted on the other parts."""

Layers = tuple[Tensor, Tensor, Tensor]


def fit_jump(known: Tensor, missing: Tensor, episodes: IntArray, seed: int) -> tuple[Layers, Tensor] | None:
    """A network, trained on all calls, and what it would have added to each; see ``on_other_episodes``."""
    return on_other_episodes(partial(_trained, seed=seed), known, missing, episodes)


def on_other_episodes(
    fit: Callable[[Tensor, Tensor], Layers], known: Tensor, missing: Tensor, episodes: IntArray
) -> tuple[Layers, Tensor] | None:
    """A jump, fitted on all calls, and what it would have added to each had its episode not been there.

    What follows in the loop is to be fitted on the latter: a network is better on the calls that it has seen, and
    corrections that are fitted after it would take it for that good.

    Args:
        fit: makes layers of what some calls read, ``[n, I]``, and of what they miss, ``[n, D T]``.

    Returns:
        Its layers, each with the row that is added last, and ``[n, D T]``. None where that leaves over more than is
        missing, or there are fewer episodes than ``FOLDS``.
    """
    numbers, of_call = np.unique(episodes, return_inverse=True)
    if len(numbers) < FOLDS:
        return None
    added = torch.zeros_like(missing)
    for fold in range(FOLDS):
        apart = torch.from_numpy(of_call % FOLDS == fold)
        added[apart] = through(fit(known[~apart], missing[~apart]), known[apart])
    if not (missing - added).square().mean() < missing.square().mean():
        return None
    return fit(known, missing), added


def _trained(known: Tensor, missing: Tensor, seed: int) -> Layers:
    """Least squares by AdamW; inputs and targets are scaled for it, and the layers hold the scales again."""
    draw = torch.Generator().manual_seed(seed)
    center, width = known.mean(0), known.std(0).clamp(min=1e-6)
    scale = missing.std().clamp(min=1e-12)
    read, wanted = (known - center) / width, missing / scale

    def fresh(inputs: int, outputs: int, size: float) -> Tensor:
        drawn: Tensor = (torch.rand(inputs + 1, outputs, generator=draw) * 2 - 1) * (size / inputs**0.5)
        return drawn.requires_grad_()

    layers = fresh(known.shape[1], HIDDEN, 1), fresh(HIDDEN, HIDDEN, 1), fresh(HIDDEN, missing.shape[1], 0)
    adam, size = torch.optim.AdamW(layers, RATE, weight_decay=DECAY), min(BATCH, len(known))
    updates = EPOCHS * (len(known) // size)
    rates = torch.optim.lr_scheduler.OneCycleLR(adam, RATE, total_steps=updates)
    with torch.enable_grad():
        for _ in range(EPOCHS):
            order = torch.randperm(len(known), generator=draw)
            for begin in range(0, len(known) - size + 1, size):
                some = order[begin : begin + size]
                adam.zero_grad()
                (through(layers, read[some]) - wanted[some]).square().mean().backward()  # type: ignore[no-untyped-call]
                adam.step()
                rates.step()
    inner, middle, outer = (layer.detach() for layer in layers)
    plain = inner[:-1] / width[:, None]
    inner = torch.cat([plain, (inner[-1] - center @ plain)[None]])
    return inner, middle, outer * scale
