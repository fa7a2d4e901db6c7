"""Rules of FastCache and ToCa, as their authors' code has them; ``sources.py`` measures them.

``tests/rivals/golden`` has what that code decides on the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

QUANTILE = 1.96
"""Of a normal distribution: FastCache's, for a confidence of 95 %."""

LEAST = 0.05
"""Relative change below which FastCache leaves a block out in any case: its default."""

WAITED, INTERVAL = 0.25, 4
"""ToCa's defaults: what it adds to the score of a token that has waited, and for how many steps."""

Keeps = Callable[[Tensor, int], Tensor]
"""Of relative changes ``[B]`` at a step: which of them are small enough to leave a block out, ``[B]``."""


def below(threshold: float) -> Keeps:
    """One threshold for all steps."""
    return lambda change, k: change <= threshold


def paper_threshold(size: int) -> float:
    """FastCache's, as its paper has it: the root of chi-square's quantile by its degrees of freedom, by a normal one.

    Args:
        size: numbers of a block's input, tokens times width.
    """
    return math.sqrt(1 + QUANTILE * math.sqrt(2 / size))


def authors_keep(change: Tensor, timestep: float, size: int) -> Tensor:
    """Which blocks FastCache's authors' code leaves out, ``[B]``.

    Its threshold is the lower one of its paper's and of another that grows with the change, but ``LEAST`` at least. No
    change above 0.02 is below that other one, which has half of the change in it: so ``LEAST`` decides, always.
    (``xfuser/model_executor/accelerator/fastcache.py``)

    Args:
        change: relative, ``[B]``.
        timestep: what the network is given.
        size: numbers of a block's input.
    """
    at = timestep / 1000
    adaptive = 0.01 + 0.5 * change - 0.002 * at + 0.00005 * at**2
    return change <= adaptive.clamp(max=paper_threshold(size)).clamp(min=LEAST)


def toca_score(tokens: Tensor, cached: Tensor, waited: Tensor) -> Tensor:
    """ToCa's: how unlike what a block is given and gave last are, and how many steps a token has waited.

    Its other scores read the maps of the attention, or reward the best of four neighbours of a picture.

    Args:
        tokens: ``[B, N, D]``, and ``cached`` likewise.
        waited: ``[B, N]``.

    Returns:
        ``[B, N]``; the highest are computed.
    """
    unlike = 1 - torch.nn.functional.cosine_similarity(tokens, cached, dim=-1)
    return torch.nn.functional.normalize(unlike, dim=-1) + WAITED * waited / INTERVAL


class Gate:
    """Says which streams compute a block: those whose input has changed since it last was."""

    def __init__(self, keeps: Keeps) -> None:
        self._keeps, self._before = keeps, dict[int, Tensor]()

    def __call__(self, k: int, b: int, given: Tensor) -> Tensor:
        """``[B, size]`` -> bool ``[B]``; the first input of a block is always computed."""
        before = self._before.get(b, torch.full_like(given, float("nan")))
        new: Tensor = ~self._keeps((given - before).norm(dim=1) / before.norm(dim=1), k)
        self._before[b] = torch.where(new[:, None], given, before)
        return new
