"""How a network of Diffusion Policy is given the observation: as tokens, as a vector, at its steps, or in the sample.

Each is ``forward(sample, timestep, obs)`` as the compiler takes it, and as the denoiser of an ``EncodedDenoiser`` whose
encoder gives the features of each observed step.
"""

from __future__ import annotations

import torch
from torch import nn


class _Given(nn.Module):
    """What is given an observation in some way."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model


class TokensDenoiser(_Given):
    """The observed steps are tokens of the network's own.

    Args:
        model: ``model(sample, timestep, tokens)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        return self.model(sample, timestep, obs)  # type: ignore[no-any-return]


class GlobalDenoiser(_Given):
    """The observed steps are one vector, the same for the whole chunk.

    Args:
        model: ``model(sample, timestep, global_cond=vector)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        return self.model(sample, timestep, global_cond=obs.flatten(1))  # type: ignore[no-any-return]


class LocalDenoiser(_Given):
    """The observed steps stand beside the first To of the sample; beside the others are zeros.

    Args:
        model: ``model(sample, timestep, local_cond=steps)``.
    """

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        placed = nn.functional.pad(obs, (0, 0, 0, sample.shape[1] - obs.shape[1]))
        return self.model(sample, timestep, local_cond=placed)  # type: ignore[no-any-return]


class InpaintingDenoiser(nn.Module):
    """The sample holds the observation: its channels are action, then observation.

    The first To rows of the observation channels are overwritten before every evaluation, here inside the module. What
    the sampler makes of the overwritten entries is never read: every later evaluation overwrites them again, and they
    are not part of the action.
    """

    observed: torch.Tensor

    def __init__(self, model: nn.Module, sample: tuple[int, int], action_dim: int, n_obs_steps: int) -> None:
        super().__init__()
        self.model = model
        self.action_dim = action_dim
        self.n_obs_steps = n_obs_steps
        observed = torch.zeros(sample, dtype=torch.bool)
        observed[:n_obs_steps, action_dim:] = True
        self.register_buffer("observed", observed, persistent=False)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da + Do]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da + Do]``."""
        steps = sample.shape[1]
        placed = nn.functional.pad(obs, (self.action_dim, 0, 0, steps - self.n_obs_steps))
        return self.model(torch.where(self.observed[:steps], placed, sample), timestep)  # type: ignore[no-any-return]
