"""GR00T N1.7's action head: layers of one attention each, to the vision-language features and to itself by turns.

Parameters are called as in the original. Encoder and decoder of the actions have weights for each embodiment; here the
embodiment is chosen when the policy is compiled.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


class _Embodied(nn.Module):
    """A linear layer with weights for each embodiment."""

    def __init__(self, kinds: int, features: int, out: int) -> None:
        super().__init__()
        self.W, self.b = nn.Parameter(torch.zeros(kinds, features, out)), nn.Parameter(torch.zeros(kinds, out))

    def forward(self, x: Tensor, kind: int) -> Tensor:
        return x @ self.W[kind] + self.b[kind]


class _Encoder(nn.Module):
    def __init__(self, kinds: int, actions: int, width: int) -> None:
        super().__init__()
        self.W1, self.W2 = _Embodied(kinds, actions, width), _Embodied(kinds, 2 * width, width)
        self.W3 = _Embodied(kinds, width, width)

    def forward(self, x: Tensor, bucket: Tensor, kind: int) -> Tensor:
        x = self.W1(x, kind)
        half = x.shape[-1] // 2
        angle = bucket[:, None] * torch.exp(-torch.arange(half) * (math.log(10000) / half))
        time = torch.cat([angle.sin(), angle.cos()], -1)[:, None].expand_as(x)
        return self.W3(functional.silu(self.W2(torch.cat([x, time], -1), kind)), kind)


class _Decoder(nn.Module):
    def __init__(self, kinds: int, width: int, hidden: int, actions: int) -> None:
        super().__init__()
        self.layer1, self.layer2 = _Embodied(kinds, width, hidden), _Embodied(kinds, hidden, actions)

    def forward(self, x: Tensor, kind: int) -> Tensor:
        return self.layer2(functional.relu(self.layer1(x, kind)), kind)


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int, source: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_q, self.to_k, self.to_v = nn.Linear(width, width), nn.Linear(source, width), nn.Linear(source, width)
        self.to_out = nn.ModuleList([nn.Linear(width, width)])

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        parts = (self.to_q(x), self.to_k(memory), self.to_v(memory))
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        return self.to_out[0](functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class _AdaNorm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 2 * width)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        scale, shift = self.linear(functional.silu(time))[:, None].chunk(2, -1)
        return functional.layer_norm(x, x.shape[-1:]) * (1 + scale) + shift


class _Up(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Linear(width, 4 * width)

    def forward(self, x: Tensor) -> Tensor:
        return functional.gelu(self.proj(x), approximate="tanh")


class _FeedForward(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.net = nn.ModuleList([_Up(width), nn.Identity(), nn.Linear(4 * width, width)])

    def forward(self, x: Tensor) -> Tensor:
        return self.net[2](self.net[0](x))


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int, source: int) -> None:
        super().__init__()
        self.norm1, self.attn1, self.ff = _AdaNorm(width), _Attention(width, heads, source), _FeedForward(width)

    def forward(self, x: Tensor, memory: Tensor | None, time: Tensor) -> Tensor:
        n = self.norm1(x, time)
        x = self.attn1(n, n if memory is None else memory) + x
        return self.ff(functional.layer_norm(x, x.shape[-1:])) + x


class _Time(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.timestep_embedder: Any = nn.Module()
        self.timestep_embedder.linear_1 = nn.Linear(256, width)
        self.timestep_embedder.linear_2 = nn.Linear(width, width)

    def forward(self, bucket: Tensor) -> Tensor:
        angle = bucket[:, None] * torch.exp(-math.log(10000) * torch.arange(128, dtype=torch.float32) / 127)
        wave = torch.cat([angle.cos(), angle.sin()], -1)
        return self.timestep_embedder.linear_2(functional.silu(self.timestep_embedder.linear_1(wave)))


class _DiT(nn.Module):
    def __init__(self, width: int, heads: int, layers: int, source: int, out: int) -> None:
        super().__init__()
        self.timestep_encoder = _Time(width)
        self.transformer_blocks = nn.ModuleList(_Layer(width, heads, width if i % 2 else source) for i in range(layers))
        self.proj_out_1, self.proj_out_2 = nn.Linear(width, 2 * width), nn.Linear(width, out)

    def forward(self, x: Tensor, memory: Tensor, bucket: Tensor) -> Tensor:
        time = self.timestep_encoder(bucket)
        for i, layer in enumerate(self.transformer_blocks):
            x = layer(x, None if i % 2 else memory, time)
        shift, scale = self.proj_out_1(functional.silu(time))[:, None].chunk(2, -1)
        return self.proj_out_2(functional.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift)


class GR00THead(nn.Module):
    """One evaluation of the velocity.

    Inputs: ``sample [B, T, D]``, ``timestep [B]`` in 0..1, ``features [B, S, .]`` of the vision-language model,
    ``state [B, 1, width]``, encoded.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        layers: int,
        source: int,
        out: int,
        actions: int,
        embodiments: int,
        embodiment: int,
    ) -> None:
        super().__init__()
        self.embodiment = embodiment
        self.action_encoder = _Encoder(embodiments, actions, width)
        self.position_embedding = nn.Embedding(10, width)
        self.model = _DiT(width, heads, layers, source, out)
        self.action_decoder = _Decoder(embodiments, out, width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, features: Tensor, state: Tensor) -> Tensor:
        bucket, count = (timestep * 1000).floor(), sample.shape[1]
        x = self.action_encoder(sample, bucket, self.embodiment) + self.position_embedding(torch.arange(count))
        x = self.model(torch.cat([state, x], 1), features, bucket)
        return self.action_decoder(x, self.embodiment)[:, -count:]
