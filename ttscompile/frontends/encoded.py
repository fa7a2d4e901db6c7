"""A denoiser behind an observation encoder."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn


class EncodedDenoiser(nn.Module):
    """A denoiser whose observations go through an encoder that the original evaluates once a call, not once a step.

    Captured as one module; the encoder depends on the observation alone, so hoisting takes it out of the loop. What
    runs or measures the original asks ``parts`` for it, and evaluates or counts it once.
    """

    def __init__(self, encoder: nn.Module, denoiser: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.denoiser = denoiser

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` and the observations by key -> ``[B, T, D]``."""
        return self.denoiser(sample, timestep, self.encoder(observations))  # type: ignore[no-any-return]


class Parts(NamedTuple):
    """What the original evaluates: the encoder, if there is one, once a call; the denoiser at every step."""

    encoder: nn.Module | None
    denoiser: nn.Module


def parts(module: nn.Module) -> Parts:
    """The parts of a network as a frontend or a user gives it: the one place that asks of which class it is."""
    return Parts(module.encoder, module.denoiser) if isinstance(module, EncodedDenoiser) else Parts(None, module)
