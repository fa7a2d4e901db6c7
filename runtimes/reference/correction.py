"""``core.correction`` with torch, differentiable: what a correction adds to a sample, and what it remembers."""

from __future__ import annotations

import torch
from torch import Tensor

from ttscompile.core.correction import HISTORY


def empty_history(sample: Tensor) -> Tensor:
    """The history before the first anchor: zeros ``[B, 4 T, D]`` for samples ``[B, T, D]``."""
    streams, horizon, dimensions = sample.shape
    return sample.new_zeros(streams, HISTORY * horizon, dimensions)


def features(sample: Tensor, prediction: Tensor, history: Tensor) -> Tensor:
    """What the correction of a step is linear in, ``[D, B, 6 T]``."""
    return torch.cat([sample, prediction, history], dim=1).permute(2, 0, 1)


def correct(weights: Tensor, bias: Tensor, sample: Tensor, prediction: Tensor, history: Tensor) -> Tensor:
    """What the correction of a step adds to the next sample, ``[B, T, D]``.

    Args:
        weights: of the step, ``[G, 6 T, T]``.
        bias: of the step, ``[G, 1, T]``.
        sample: of the step, ``[B, T, D]``.
        prediction: of the step, ``[B, T, D]``.
        history: ``[B, 4 T, D]``.
    """
    return (features(sample, prediction, history) @ weights + bias).permute(1, 2, 0)


def remember(sample: Tensor, prediction: Tensor, history: Tensor) -> Tensor:
    """The history after an anchor."""
    return torch.cat([sample, prediction, history[:, : history.shape[1] // 2]], dim=1)
