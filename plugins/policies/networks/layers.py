"""Layers that several action heads have; parameters are called as in the originals."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

_WAVES, _LONGEST = 128, 10_000
"""Of the timestep: pairs of sine and cosine, and the longest period."""


class TimestepEmbedder(nn.Module):
    """DiT's: 256 waves of periods up to 10,000, then an MLP, ``[B] -> [B, width]``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(2 * _WAVES, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: Tensor) -> Tensor:
        """See the class."""
        rates = torch.exp(-math.log(_LONGEST) * torch.arange(_WAVES, dtype=torch.float32) / _WAVES)
        angle = t[:, None].float() * rates
        embedded: Tensor = self.mlp(torch.cat([angle.cos(), angle.sin()], -1))
        return embedded


class ModulatedFinal(nn.Module):
    """The parameters of a last layer whose shift and scale depend on the condition; each head applies them its way."""

    def __init__(self, width: int, actions: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, actions)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))


class TimmAttention(nn.Module):
    """timm's self-attention: one projection for query, key and value, which may have no bias."""

    def __init__(self, width: int, count: int, biased: bool = True) -> None:
        super().__init__()
        self.count = count
        self.qkv, self.proj = nn.Linear(width, 3 * width, bias=biased), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """``[B, T, width]`` to the same."""
        q, k, v = (split(part, self.count) for part in self.qkv(x).chunk(3, -1))
        added: Tensor = self.proj(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return added


class TimmMlp(nn.Module):
    """timm's feed-forward, so many times as wide inside, with GELU as it is or as the hyperbolic tangent gives it."""

    def __init__(self, width: int, out: int | None = None, times: int = 4, exact: bool = False) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, times * width), nn.Linear(times * width, out or width)
        self.approximate = "none" if exact else "tanh"

    def forward(self, x: Tensor) -> Tensor:
        """``[B, T, width]`` to ``[B, T, out]``."""
        added: Tensor = self.fc2(functional.gelu(self.fc1(x), approximate=self.approximate))
        return added


def split(x: Tensor, count: int) -> Tensor:
    """``[B, T, E]`` to ``[B, count, T, E / count]``."""
    parts: Tensor = torch.unflatten(x, -1, (count, -1))
    return parts.transpose(1, 2)
