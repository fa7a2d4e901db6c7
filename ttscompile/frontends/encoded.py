"""A denoiser behind an observation encoder."""

from __future__ import annotations

import torch
from torch import nn


class EncodedDenoiser(nn.Module):
    """A denoiser whose observations go through an encoder that the original evaluates once a call, not once a step.

    Captured as one module; the encoder depends on the observation alone, so hoisting takes it out of the loop. What
    measures the original, its FLOPs and its time, asks for this class, and counts the encoder once.

    Args:
        encoder: ``encoder(observations)``, a dictionary by key to what the denoiser takes.
        denoiser: ``denoiser(sample, timestep, encoded)``.
    """

    def __init__(self, encoder: nn.Module, denoiser: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.denoiser = denoiser

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` and the observations by key -> ``[B, T, D]``."""
        prediction: torch.Tensor = self.denoiser(sample, timestep, self.encoder(observations))
        return prediction
