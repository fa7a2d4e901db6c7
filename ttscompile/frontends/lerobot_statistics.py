"""How LeRobot normalises a feature: the arithmetic, on the way in and on the way out.

Source: ``lerobot.processor`` of huggingface/lerobot 0.6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from ..core.spec import Affine

Features = Mapping[str, tuple[str, tuple[int, ...]]]
"""Type (``STATE``, ``VISUAL``, ``ACTION``) and shape by the policy's name, as its configuration has them."""

STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""The two statistics of each mode."""

_LEAST_STD = 1e-30
"""Stands for a standard deviation of zero, which gives the mean whatever the network says."""


@dataclass(frozen=True)
class Statistics:
    """How one feature is normalised: its mode, and the two statistics that the mode names, float32.

    Attributes:
        mode: ``MEAN_STD``, ``MIN_MAX``, ``QUANTILES`` or ``QUANTILE10``.
        first: mean, or the lower end of the range.
        second: standard deviation, or the upper end.
        eps: of the processor's configuration.
    """

    mode: str
    first: torch.Tensor
    second: torch.Tensor
    eps: float

    @property
    def width(self) -> torch.Tensor:
        """What is divided by: ``std + eps``; or the range, and ``eps`` where that is zero."""
        if self.mode == "MEAN_STD":
            return self.second + self.eps
        width = self.second - self.first
        return torch.where(width == 0, torch.tensor(self.eps, dtype=width.dtype), width)

    @property
    def usual_range(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Of a vector: where its values usually are, by these statistics; of MEAN_STD two deviations to each side."""
        low, high = self.first, self.second
        if self.mode == "MEAN_STD":
            low, high = self.first - 2 * self.second, self.first + 2 * self.second
        low, high = torch.minimum(low, high), torch.maximum(low, high)
        return tuple(low.tolist()), tuple(high.tolist())

    def inverse(self) -> Affine:
        """The inverse as an ``Affine``, for vectors. MEAN_STD inverts with the bare standard deviation."""
        first = self.first.double().numpy()
        if self.mode == "MEAN_STD":
            scale = 1 / np.maximum(self.second.double().numpy(), _LEAST_STD)
            return Affine(scale=scale.astype(np.float32), offset=(-first * scale).astype(np.float32))
        scale = 2 / self.width.double().numpy()
        return Affine(scale=scale.astype(np.float32), offset=(-first * scale - 1).astype(np.float32))


class Normalizer(nn.Module):
    """``(x - mean) / (std + eps)``, or ``2 (x - low) / range - 1``, as LeRobot writes it.

    It is part of the compiled network rather than an ``Affine`` of the observation: images are normalised by channel,
    and a channel that never changed in training is divided by 1e-8, which only this order of operations survives.

    Args:
        statistics: of a feature, broadcast against its values; None leaves them as they are.
    """

    first: torch.Tensor
    width: torch.Tensor

    def __init__(self, statistics: Statistics | None) -> None:
        super().__init__()
        self.mode = None if statistics is None else statistics.mode
        if statistics is not None:
            self.register_buffer("first", statistics.first, persistent=False)
            self.register_buffer("width", statistics.width, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, To, ...]`` -> the same."""
        if self.mode is None:
            return x
        if self.mode == "MEAN_STD":
            return (x - self.first) / self.width
        return 2 * (x - self.first) / self.width - 1
