"""The networks of ``large.py``, with random weights: what takes a sample, a timestep and an observation vector."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig

ACTIONS, OBSERVED = 14, 64
"""Channels of an action, and numbers of an observation."""


def transformer(layers: int, width: int) -> nn.Module:
    """A DiT with adaLN-Zero; nothing in it is made for ttscompile."""

    torch.manual_seed(0)

    class Layer(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
            self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
            self.modulate = nn.Linear(width, 6 * width)

        def forward(self, x: Tensor, c: Tensor) -> Tensor:
            s1, c1, g1, s2, c2, g2 = self.modulate(functional.silu(c))[:, None].chunk(6, -1)
            n = functional.layer_norm(x, (width,)) * (1 + c1) + s1
            q, k, v = (part.unflatten(-1, (-1, 64)).transpose(1, 2) for part in self.qkv(n).chunk(3, -1))
            x = x + g1 * self.out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
            n = functional.layer_norm(x, (width,)) * (1 + c2) + s2
            return x + g2 * self.down(functional.gelu(self.up(n), approximate="tanh"))

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.embed, self.head = nn.Linear(ACTIONS, width), nn.Linear(width, ACTIONS)
            self.observe, self.time = nn.Linear(OBSERVED, width), nn.Linear(256, width)
            self.layers = nn.ModuleList(Layer() for _ in range(layers))

        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            angle = timestep[:, None] * torch.exp(-torch.arange(128) / 14)
            c = self.time(torch.cat([angle.sin(), angle.cos()], -1)) + self.observe(obs)
            x = self.embed(sample)
            for layer in self.layers:
                x = layer(x, c)
            return self.head(functional.layer_norm(x, (width,)))

    return Network()


def unet(dims: Sequence[int]) -> nn.Module:
    """The U-Net of Diffusion Policy and LeRobot with these levels; their kernels, groups and FiLM."""

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = ConditionalUnet1D(UNetConfig(ACTIONS, None, OBSERVED, 128, tuple(dims), 5, 8, True))

        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            return self.net(sample, timestep, obs)

    return Network()
