"""Policies that give their actions in one evaluation, as ACT does: a module, and its table of one step, no noise."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from ..core.spec import SamplerTable
from .flow import deterministic_table


class DirectDenoiser(nn.Module):
    """The network as ``compile_denoiser`` takes it: ``forward(sample, timestep, **observations)``.

    ``network(**observations)`` gives the actions ``[B, T, D]``; all of it leaves the loop. A residual stream begins
    with the sample, so that is read, and nothing depends on it.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` -> ``[B, T, D]``."""
        return self.network(**observations) + 0 * sample  # type: ignore[no-any-return]


def direct_table() -> SamplerTable:
    """The loop of a ``DirectDenoiser``: one step, whose result is the prediction."""
    return deterministic_table("direct", np.zeros(1), None, out_to_x0=np.ones(1), x0_to_next=np.ones(1))
