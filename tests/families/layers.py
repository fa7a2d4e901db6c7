"""Layers as people write them: by hand, fused, rotary, normalised; parts of the modules in this folder."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class Root(nn.Module):
    """RMSNorm as Llama has it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.g = nn.Parameter(1 + 0.1 * torch.randn(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + 1e-6) * self.g


class Waves(nn.Module):
    """Sinusoidal embedding of the timestep and two linear layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.count = width // 2
        self.up, self.down = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, t: Tensor) -> Tensor:
        frequencies = torch.exp(-math.log(10000) * torch.arange(self.count, dtype=torch.float32) / self.count)
        angle = t[:, None].float() * frequencies[None]
        return self.down(functional.silu(self.up(torch.cat([angle.cos(), angle.sin()], -1))))


class GatedFeedForward(nn.Module):
    """Llama's, with SiLU, and Gemma's, with GELU; SmolVLA, Dita and pi0 have them.

    Args:
        width: of the stream.
        hidden: width inside.
        activation: of the gate.
    """

    def __init__(self, width: int, hidden: int, activation: nn.Module) -> None:
        super().__init__()
        self.activation = activation
        self.gate_proj, self.up_proj = (nn.Linear(width, hidden, bias=False) for _ in range(2))
        self.down_proj = nn.Linear(hidden, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_proj(self.activation(self.gate_proj(x)) * self.up_proj(x))


def heads(x: Tensor, count: int) -> Tensor:
    """``[B, T, E]`` to ``[B, count, T, E / count]``."""
    return x.unflatten(-1, (count, -1)).transpose(1, 2)


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary embedding of ``[B, H, T, C]``, the two halves of the channels as pairs."""
    channels = x.shape[-1]
    rates = 1.0 / 10000 ** (torch.arange(0, channels, 2) / channels)
    angle = positions[:, None].float() * rates
    angle = torch.cat([angle, angle], -1)
    left, right = x.chunk(2, -1)
    return x * angle.cos() + torch.cat([-right, left], -1) * angle.sin()


class Fused(nn.Module):
    """Self-attention with one projection for query, key and value, and torch's attention function.

    Args:
        width: of the stream.
        norm: of query and key; None for none.
        rope: whether query and key are rotated.
    """

    def __init__(self, width: int, norm: bool = False, rope: bool = False, count: int = 2) -> None:
        super().__init__()
        self.count, self.rope = count, rope
        self.abc, self.d = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.n1 = Root(width // count) if norm else nn.Identity()
        self.n2 = Root(width // count) if norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (heads(part, self.count) for part in self.abc(x).chunk(3, -1))
        q, k = self.n1(q), self.n2(k)
        if self.rope:
            positions = torch.arange(x.shape[1])
            q, k = rotate(q, positions), rotate(k, positions)
        return self.d(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class ByHand(nn.Module):
    """Attention with softmax written out, of ``x`` to ``memory``; ``x`` itself if there is none."""

    def __init__(self, width: int, count: int = 2) -> None:
        super().__init__()
        self.count = count
        self.w1, self.w2 = nn.Linear(width, width, bias=False), nn.Linear(width, 2 * width, bias=False)
        self.w3 = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor:
        q = heads(self.w1(x), self.count)
        k, v = (heads(part, self.count) for part in self.w2(x if memory is None else memory).chunk(2, -1))
        weights = (q @ k.transpose(-2, -1) / math.sqrt(q.shape[-1])).softmax(-1)
        return self.w3((weights @ v).transpose(1, 2).reshape(x.shape))


class Gated(nn.Module):
    """SwiGLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.p = nn.Linear(width, 2 * width, bias=False)
        self.q = nn.Linear(width, 2 * width, bias=False)
        self.r = nn.Linear(2 * width, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.r(functional.silu(self.p(x)) * self.q(x))


def feed_forward(width: int) -> nn.Sequential:
    """Two linear layers and a GELU."""
    return nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(approximate="tanh"), nn.Linear(2 * width, width))
