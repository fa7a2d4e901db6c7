"""DiT-Policy: an encoder over observation tokens, and a decoder whose layer i is modulated by mean(encoder i) + time.

Parameters are called as in the original. Everything is sequence first, ``[T, B, E]``; scales are not added to 1, and
the encoder is post-norm. It is a condition: it leaves the loop.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


class _Encoder(nn.Module):
    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads)
        self.linear1, self.linear2 = nn.Linear(width, hidden), nn.Linear(hidden, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Tensor, position: Tensor) -> Tensor:
        placed = x + position
        x = self.norm1(x + self.self_attn(placed, placed, x, need_weights=False)[0])
        return self.norm2(x + self.linear2(functional.gelu(self.linear1(x), approximate="tanh")))


class _Modulation(nn.Module):
    def __init__(self, width: int, shifts: bool) -> None:
        super().__init__()
        self.scale = nn.Linear(width, width)
        self.shift = nn.Linear(width, width) if shifts else None

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        c = functional.silu(c)
        x = x * self.scale(c)[None]
        return x if self.shift is None else x + self.shift(c)[None]


class _Decoder(nn.Module):
    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads)
        self.linear1, self.linear2 = nn.Linear(width, hidden), nn.Linear(hidden, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn_mod1, self.mlp_mod1 = _Modulation(width, True), _Modulation(width, True)
        self.attn_mod2, self.mlp_mod2 = _Modulation(width, False), _Modulation(width, False)

    def forward(self, x: Tensor, time: Tensor, encoded: Tensor) -> Tensor:
        c = encoded.mean(0) + time
        n = self.attn_mod1(self.norm1(x), c)
        x = self.attn_mod2(self.self_attn(n, n, n, need_weights=False)[0], c) + x
        n = self.mlp_mod1(self.norm2(x), c)
        return x + self.mlp_mod2(self.linear2(functional.gelu(self.linear1(n), approximate="tanh")), c)


class _Time(nn.Module):
    def __init__(self, waves: int, width: int) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.zeros(waves // 2), requires_grad=False)
        self.out_net = nn.Sequential(nn.Linear(waves, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: Tensor) -> Tensor:
        angle = t[:, None] * self.w[None]
        return self.out_net(torch.cat([angle.cos(), angle.sin()], 1))


class _Final(nn.Module):
    def __init__(self, width: int, actions: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, actions)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))


class DiTPolicyHead(nn.Module):
    """``forward_dec(forward_enc(tokens))``; inputs ``sample [B, T, D]``, ``timestep [B]``, ``tokens [B, S, E]``."""

    def __init__(
        self, width: int, heads: int, layers: int, hidden: int, waves: int, horizon: int, actions: int
    ) -> None:
        super().__init__()
        self.dec_pos = nn.Parameter(torch.zeros(horizon, 1, width))
        self.time_net = _Time(waves, width)
        self.ac_proj = nn.Sequential(
            nn.Linear(actions, actions), nn.GELU(approximate="tanh"), nn.Linear(actions, width)
        )
        self.encoder: Any = nn.Module()
        self.decoder: Any = nn.Module()
        self.encoder.layers = nn.ModuleList(_Encoder(width, heads, hidden) for _ in range(layers))
        self.decoder.layers = nn.ModuleList(_Decoder(width, heads, hidden) for _ in range(layers))
        self.eps_out = _Final(width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, tokens: Tensor) -> Tensor:
        memory = tokens.transpose(0, 1)
        place = torch.arange(memory.shape[0]).float()[:, None]
        angle = place * torch.exp(torch.arange(0, memory.shape[2], 2).float() * -(math.log(10000.0) / memory.shape[2]))
        position = torch.stack([angle.sin(), angle.cos()], -1).flatten(1)[:, None].repeat(1, memory.shape[1], 1)
        time = self.time_net(timestep)
        x = self.ac_proj(sample).transpose(0, 1) + self.dec_pos
        for encode, decode in zip(self.encoder.layers, self.decoder.layers, strict=True):
            memory = encode(memory, position)
            x = decode(x, time, memory)
        shift, scale = self.eps_out.adaLN_modulation(memory.mean(0) + time).chunk(2, 1)
        return self.eps_out.linear(x * scale[None] + shift[None]).transpose(0, 1)
