"""Fit a jump: a small network for what the steps between two anchors leave over, where it holds on other episodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..core.correction import HIDDEN
from ..runtimes.reference.sampler import through
from .calls import IntArray

EPOCHS, BATCH = 60, 256
"""Passes over the calls, and calls an update: after twice as many it is no better."""

RATE, DECAY = 2e-3, 0.3
"""The largest step of AdamW, which grows to that in the first third of the updates and falls to zero in the others; and
the decay of the weights."""

FOLDS = 4
"""Parts of the episodes; each call is judged by a network that was fitted on the other parts."""

Layers = tuple[Tensor, Tensor, Tensor]


def fit_jump(known: Tensor, missing: Tensor, episodes: IntArray, seed: int) -> tuple[Layers, Tensor] | None:
    """A network, trained on all calls, and what it would have added to each; see ``on_other_episodes``.

    Args:
        seed: of the weights that training begins with, and of the order of the calls.
    """
    return on_other_episodes(partial(_trained, seed=seed), known, missing, episodes)


def on_other_episodes(
    fit: Callable[[Tensor, Tensor], Layers], known: Tensor, missing: Tensor, episodes: IntArray
) -> tuple[Layers, Tensor] | None:
    """A jump, fitted on all calls, and what it would have added to each had its episode not been there.

    What follows in the loop is to be fitted on the latter: a network is better on the calls that it has seen, and
    corrections that are fitted after it would take it for that good.

    Args:
        fit: makes layers of what some calls read and what they miss.
        known: what it reads, ``[n, I]``.
        missing: what should be added, ``[n, D T]``.
        episodes: of each call, ``[n]``.

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
