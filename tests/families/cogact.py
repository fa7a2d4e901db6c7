"""CogACT's action model with its guidance: the batch is doubled, with the cognition token and with the learned none.

Parameters are called as in the original. Token 0 is the sum of timestep and condition.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import TimestepEmbedder, TimmAttention, TimmMlp


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.mlp = TimmAttention(width, heads), TimmMlp(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(functional.layer_norm(x, x.shape[-1:], eps=1e-6))
        return x + self.mlp(functional.layer_norm(x, x.shape[-1:], eps=1e-6))


class _Linear(nn.Module):
    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear(x)


class CogACTHead(nn.Module):
    """``forward_with_cfg``, which doubles the batch, on a batch that is not doubled yet.

    Inputs: ``sample [B, T, D]``, ``timestep [B]``, ``cognition [B, 1, .]``.
    """

    def __init__(
        self, width: int, heads: int, layers: int, horizon: int, actions: int, cognition: int, guidance: float
    ) -> None:
        super().__init__()
        self.guidance = guidance
        self.z_embedder: Any
        self.x_embedder, self.t_embedder, self.z_embedder = (
            _Linear(actions, width),
            TimestepEmbedder(width),
            nn.Module(),
        )
        self.z_embedder.linear = nn.Linear(cognition, width)
        self.z_embedder.uncondition = nn.Parameter(torch.zeros(1, cognition))
        self.positional_embedding = nn.Parameter(torch.zeros(horizon + 1, width))
        self.blocks = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.final_layer = _Linear(width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, cognition: Tensor) -> Tensor:
        none = self.z_embedder.uncondition[None].expand(len(sample), -1, -1)
        z = self.z_embedder.linear(torch.cat([cognition, none], 0))
        c = self.t_embedder(torch.cat([timestep, timestep], 0))[:, None] + z
        x = torch.cat([c, self.x_embedder(torch.cat([sample, sample], 0))], 1) + self.positional_embedding
        for layer in self.blocks:
            x = layer(x)
        x = self.final_layer(functional.layer_norm(x, x.shape[-1:], eps=1e-6))[:, 1:]
        given, free = torch.split(x, len(x) // 2, dim=0)
        return free + self.guidance * (given - free)
