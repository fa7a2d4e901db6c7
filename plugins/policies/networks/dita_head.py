"""Dita's denoiser: a causal Llama over words, pictures, the timestep and the actions, a token each.

Parameters are called as in the original, ``scripts/llama_dp.py`` of RoboDita/Dita (arXiv 2503.19757), which evaluates
all tokens at every step. No token sees those behind it, so keys and values of the prefix and of the timestep are
computed apart from those of the actions. The ones are computed once a call; the others are made for all steps in one
batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .language_layers import FeedForward, LanguageConfig, Norm

Cache = list[tuple[Tensor, Tensor]]


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj, self.k_proj, self.v_proj, self.o_proj = (nn.Linear(width, width, bias=False) for _ in range(4))

    def forward(self, x: Tensor, past: tuple[Tensor, Tensor] | None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        q, k, v = (
            p(x).unflatten(-1, (self.heads, -1)).transpose(1, 2) for p in (self.q_proj, self.k_proj, self.v_proj)
        )
        before = 0 if past is None else past[0].shape[2]
        q, k = _rotated(q, before), _rotated(k, before)
        if past is not None:
            k, v = (_joined(seen, own) for seen, own in zip(past, (k, v), strict=True))
        mask = torch.ones(x.shape[1], before + x.shape[1], dtype=torch.bool).tril(before)
        y = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.o_proj(y.transpose(1, 2).flatten(2)), (k, v)


def _joined(seen: Tensor, own: Tensor) -> Tensor:
    if seen.shape[0] == 1:  # one instruction, known when the policy is compiled, for all streams
        seen = seen.expand(own.shape[0], -1, -1, -1)
    return torch.cat([seen, own], 2)


def _rotated(x: Tensor, start: int) -> Tensor:
    """Rotary embedding of ``[B, H, T, C]`` from a position on, the two halves of the channels as pairs."""
    rates = 1.0 / 10000 ** (torch.arange(0, x.shape[-1], 2).float() / x.shape[-1])
    angle = torch.arange(start, start + x.shape[2]).float()[:, None] * rates.repeat(2)
    left, right = x.chunk(2, -1)
    return x * angle.cos() + torch.cat([-right, left], -1) * angle.sin()


class _Layer(nn.Module):
    def __init__(self, config: LanguageConfig) -> None:
        super().__init__()
        self.self_attn, self.mlp = _Attention(config.width, config.heads), FeedForward(config)
        self.input_layernorm, self.post_attention_layernorm = Norm(config), Norm(config)

    def forward(self, x: Tensor, past: tuple[Tensor, Tensor] | None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        y, own = self.self_attn(self.input_layernorm(x), past)
        x = x + y
        return x + self.mlp(self.post_attention_layernorm(x)), own


class DitaHead(nn.Module):
    """``forward`` on the tokens of the prefix; inputs ``sample [B, T, D]``, ``timestep [B]``, ``prefix [B, P, E]``.

    The prefix is the words of the instruction (CLIP), then the tokens of the frames: one tensor, or each apart.
    """

    def __init__(self, width: int, heads: int, hidden: int, layers: int, actions: int) -> None:
        super().__init__()
        self.width = width
        self.transformer: Any = nn.Module()
        self.transformer.model = nn.Module()
        config = LanguageConfig(width, hidden, layers, heads, heads, width // heads)
        self.transformer.model.layers = nn.ModuleList(_Layer(config) for _ in range(layers))
        self.transformer.model.norm = Norm(config)
        self.transformer.lm_head = nn.Linear(width, actions, bias=False)

    def _through(self, x: Tensor, past: Cache | None) -> tuple[Tensor, Cache]:
        """Tokens behind those whose keys and values are given, and the keys and values of both."""
        layers = self.transformer.model.layers
        every = []
        for layer, seen in zip(layers, [None] * len(layers) if past is None else past, strict=True):
            x, own = layer(x, seen)
            every.append(own)
        return x, every

    def forward(self, sample: Tensor, timestep: Tensor, prefix: Tensor | Sequence[Tensor]) -> Tensor:
        """See the class."""
        half = self.width // 2
        wave = timestep[:, None] * torch.exp(torch.arange(half) * (-math.log(10000) / (half - 1)))
        time = torch.cat([wave.sin(), wave.cos()], -1)[:, None]
        actions = functional.pad(sample, (0, self.width - sample.shape[-1]))
        past: Cache | None = None
        for before in (*([prefix] if isinstance(prefix, Tensor) else prefix), time):
            _, past = self._through(before, past)
        x, _ = self._through(actions, past)
        return self.transformer.lm_head(self.transformer.model.norm(x))  # type: ignore[no-any-return]
