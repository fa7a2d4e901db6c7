"""The action experts of pi0 and pi0.5, one denoising step: Gemma layers over [prefix; suffix], GeGLU feed-forward.

Parameters are called as in LeRobot's checkpoints. In pi0.5 the norms are modulated by the timestep alone, and gate what
they norm: all of that is a table.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import GatedFeedForward


class _Norm(nn.Module):
    """RMSNorm times 1 + weight; or modulated, with a gate for the branch behind it."""

    def __init__(self, width: int, adaptive: bool) -> None:
        super().__init__()
        if adaptive:
            self.dense = nn.Linear(width, 3 * width)
        else:
            self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, time: Tensor | None) -> tuple[Tensor, Tensor | None]:
        x = x * torch.rsqrt(x.square().mean(-1, keepdim=True) + 1e-6)
        if time is None:
            return x * (1 + self.weight), None
        scale, shift, gate = self.dense(time)[:, None].chunk(3, -1)
        return x * (1 + scale) + shift, gate


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int, groups: int, channels: int) -> None:
        super().__init__()
        self.repeats, self.channels = heads // groups, channels
        self.q_proj = nn.Linear(width, heads * channels, bias=False)
        self.k_proj = nn.Linear(width, groups * channels, bias=False)
        self.v_proj = nn.Linear(width, groups * channels, bias=False)
        self.o_proj = nn.Linear(heads * channels, width, bias=False)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, bias: Tensor, angle: Tensor) -> Tensor:
        """``keys`` and ``values [B, P, G, C]``, ``bias [B, T, P + T]``, ``angle [B, T, C]``."""
        q, k, v = (p(x).unflatten(-1, (-1, self.channels)) for p in (self.q_proj, self.k_proj, self.v_proj))
        q, k = (one * angle.cos()[:, :, None] + _turned(one) * angle.sin()[:, :, None] for one in (q, k))
        k, v = torch.cat([keys, k], 1), torch.cat([values, v], 1)
        k, v = (one.transpose(1, 2).repeat_interleave(self.repeats, 1) for one in (k, v))
        scores = q.transpose(1, 2) @ k.transpose(2, 3) * self.channels**-0.5 + bias[:, None]
        return self.o_proj((scores.softmax(-1) @ v).transpose(1, 2).flatten(2))


def _turned(x: Tensor) -> Tensor:
    left, right = x.chunk(2, -1)
    return torch.cat([-right, left], -1)


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int, groups: int, channels: int, hidden: int, adaptive: bool) -> None:
        super().__init__()
        self.self_attn = _Attention(width, heads, groups, channels)
        self.mlp = GatedFeedForward(width, hidden, nn.GELU(approximate="tanh"))
        self.input_layernorm, self.post_attention_layernorm = _Norm(width, adaptive), _Norm(width, adaptive)

    def forward(
        self, x: Tensor, keys: Tensor, values: Tensor, bias: Tensor, angle: Tensor, time: Tensor | None
    ) -> Tensor:
        n, gate = self.input_layernorm(x, time)
        y = self.self_attn(n, keys, values, bias, angle)
        x = x + (y if gate is None else y * gate)
        n, gate = self.post_attention_layernorm(x, time)
        return x + (self.mlp(n) if gate is None else self.mlp(n) * gate)


class PiHead(nn.Module):
    """``denoise_step`` given the prefix.

    Inputs: ``sample [B, T, D]``, ``timestep [B]`` in 0..1, ``prefix_mask`` bool ``[B, P]``, ``keys`` and ``values``
    ``[B, layers, P, groups, channels]``; for pi0 also ``state [B, D]``, which is the first token.

    Args:
        width: of the expert.
        heads: of the queries.
        groups: of keys and values.
        channels: of a head.
        hidden: width of the feed-forward layers.
        layers: number of them.
        actions: D.
        adaptive: pi0.5 instead of pi0.
    """

    def __init__(
        self, width: int, heads: int, groups: int, channels: int, hidden: int, layers: int, actions: int, adaptive: bool
    ) -> None:
        super().__init__()
        self.width, self.channels, self.adaptive = width, channels, adaptive
        model = nn.Module()
        model.layers = nn.ModuleList(_Layer(width, heads, groups, channels, hidden, adaptive) for _ in range(layers))
        model.norm = _Norm(width, adaptive)
        self.paligemma_with_expert: Any = nn.Module()
        self.paligemma_with_expert.gemma_expert = nn.Module()
        self.paligemma_with_expert.gemma_expert.model = model
        self.action_in_proj, self.action_out_proj = nn.Linear(actions, width), nn.Linear(width, actions)
        if adaptive:
            self.time_mlp_in, self.time_mlp_out = nn.Linear(width, width), nn.Linear(width, width)
        else:
            self.state_proj = nn.Linear(actions, width)
            self.action_time_mlp_in, self.action_time_mlp_out = nn.Linear(2 * width, width), nn.Linear(width, width)

    def forward(
        self, sample: Tensor, timestep: Tensor, prefix_mask: Tensor, keys: Tensor, values: Tensor,
        state: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        fraction = torch.linspace(0.0, 1.0, self.width // 2, dtype=torch.float64)
        wave = timestep[:, None] * (2 * math.pi / (4e-3 * (4.0 / 4e-3) ** fraction))
        time = torch.cat([wave.sin(), wave.cos()], -1).float()
        x = self.action_in_proj(sample)
        condition: Tensor | None = None
        if self.adaptive:
            condition = functional.silu(self.time_mlp_out(functional.silu(self.time_mlp_in(time))))
        else:
            assert state is not None
            x = torch.cat([x, time[:, None].expand_as(x)], 2)
            x = self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(x)))
            x = torch.cat([self.state_proj(state)[:, None], x], 1)
        batch, count = x.shape[:2]
        own = torch.ones(count, count, dtype=torch.bool)
        if not self.adaptive:
            own[0, 1:] = False  # the state does not see the actions
        seen = prefix_mask[:, None].expand(batch, count, prefix_mask.shape[1])
        bias = torch.where(torch.cat([seen, own.expand(batch, count, count)], 2), 0.0, -2.3819763e38)
        positions = (prefix_mask.sum(-1, keepdim=True) + torch.arange(count)).float()
        rates = 1.0 / 10000 ** (torch.arange(0, self.channels, 2).float() / self.channels)
        angle = positions[..., None] * rates.repeat(2)
        model = self.paligemma_with_expert.gemma_expert.model
        for i, layer in enumerate(model.layers):
            x = layer(x, keys[:, i], values[:, i], bias, angle, condition)
        x, _ = model.norm(x, condition)
        return self.action_out_proj(x[:, -sample.shape[1] :])
