"""SmolVLA's action expert, one denoising step: even layers attend to [prefix; suffix], odd layers to the prefix alone.

Parameters are called as in a SmolVLA checkpoint. Keys and values of the prefix come from the vision-language model,
rotated already; odd layers project them once more, which does not depend on the sample.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import GatedFeedForward


class _Norm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return self.weight * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + 1e-6))


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int, groups: int, channels: int, source: int) -> None:
        super().__init__()
        self.heads, self.groups, self.channels = heads, groups, channels
        self.q_proj = nn.Linear(width, heads * channels, bias=False)
        self.k_proj = nn.Linear(source, groups * channels, bias=False)
        self.v_proj = nn.Linear(source, groups * channels, bias=False)
        self.o_proj = nn.Linear(heads * channels, width, bias=False)

    def project(self, layer: nn.Linear, x: Tensor) -> Tensor:
        return layer(x).unflatten(-1, (-1, self.channels))

    def attend(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        """``q [B, T, H, C]``, ``k`` and ``v [B, S, G, C]``, mask ``[B, T, S]``, True for what is seen."""
        k, v = (one.repeat_interleave(self.heads // self.groups, dim=2).transpose(1, 2) for one in (k, v))
        scores = q.transpose(1, 2) @ k.transpose(2, 3) * self.channels**-0.5
        scores = torch.where(mask[:, None], scores, torch.finfo(torch.float32).min)
        return self.o_proj((scores.softmax(-1) @ v).transpose(1, 2).flatten(2))


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int, groups: int, channels: int, hidden: int, crosses: bool) -> None:
        super().__init__()
        self.crosses = crosses
        self.self_attn = _Attention(width, heads, groups, channels, groups * channels if crosses else width)
        self.mlp = GatedFeedForward(width, hidden, nn.SiLU())
        self.input_layernorm, self.post_attention_layernorm = _Norm(width), _Norm(width)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor) -> Tensor:
        """``keys`` and ``values [B, P, G, C]`` of the prefix; ``mask [B, P]``."""
        n, a = self.input_layernorm(x), self.self_attn
        count, (batch, prefix) = x.shape[1], mask.shape
        own = torch.arange(count)[None]
        seen = mask[:, None].expand(batch, count, prefix)
        q = a.project(a.q_proj, n)
        if self.crosses:
            k, v = (a.project(p, c.flatten(2)) for p, c in ((a.k_proj, keys), (a.v_proj, values)))
            x = x + a.attend(rotate(q, own), k, v, seen)
        else:
            positions = mask.sum(-1, keepdim=True) + own
            causal = torch.ones(count, count, dtype=torch.bool).tril()[None].expand(batch, count, count)
            k = torch.cat([keys, rotate(a.project(a.k_proj, n), positions)], 1)
            v = torch.cat([values, a.project(a.v_proj, n)], 1)
            x = x + a.attend(rotate(q, positions), k, v, torch.cat([seen, causal], 2))
        return x + self.mlp(self.post_attention_layernorm(x))


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary embedding of ``[B, T, H, C]`` at positions ``[B, T]``; the halves of the channels are the pairs."""
    half = x.shape[-1] // 2
    period = 10_000 ** (2.0 / x.shape[-1] * torch.arange(half, dtype=torch.float32))
    angle = (positions[..., None].float() / period)[..., None, :]
    left, right = x.split(half, -1)
    return torch.cat([left * angle.cos() - right * angle.sin(), right * angle.cos() + left * angle.sin()], -1)


class _Expert(nn.Module):
    def __init__(self, layers: list[_Layer], width: int) -> None:
        super().__init__()
        self.layers, self.norm = nn.ModuleList(layers), _Norm(width)


class SmolVLAHead(nn.Module):
    """``denoise_step(x_t, timestep)`` given the prefix.

    Inputs: ``sample [B, T, D]``, ``timestep [B]`` in 0..1, ``prefix_mask`` bool ``[B, P]``, ``keys`` and ``values``
    ``[B, layers, P, groups, channels]``.
    """

    def __init__(
        self, width: int, heads: int, groups: int, channels: int, hidden: int, layers: int, actions: int
    ) -> None:
        super().__init__()
        self.width = width
        each = [_Layer(width, heads, groups, channels, hidden, crosses=i % 2 == 1) for i in range(layers)]
        self.vlm_with_expert: Any = nn.Module()
        self.vlm_with_expert.lm_expert = _Expert(each, width)
        self.action_in_proj, self.action_out_proj = nn.Linear(actions, width), nn.Linear(width, actions)
        self.action_time_mlp_in, self.action_time_mlp_out = nn.Linear(2 * width, width), nn.Linear(width, width)

    def forward(self, sample: Tensor, timestep: Tensor, prefix_mask: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        x = self.action_in_proj(sample)
        fraction = torch.linspace(0.0, 1.0, self.width // 2, dtype=torch.float64)
        angle = timestep[:, None] * (2 * math.pi / (4e-3 * (4.0 / 4e-3) ** fraction))
        time = torch.cat([angle.sin(), angle.cos()], -1).float()
        x = torch.cat([x, time[:, None].expand_as(x)], 2)
        x = self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(x)))
        expert = self.vlm_with_expert.lm_expert
        for i, layer in enumerate(expert.layers):
            x = layer(x, keys[:, i], values[:, i], prefix_mask)
        return self.action_out_proj(expert.norm(x))
