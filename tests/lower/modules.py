"""Denoisers in styles that are hard to lower: heads folded into the batch, sequence first, channels first, adaLN."""

from collections.abc import Mapping
from functools import cache

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from ttscompile.capture.export import capture
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.ir.graph import Graph, TensorType

TOKENS, WIDTH, HEADS, CONDITIONS = 6, 16, 4, 3


def table(steps: int = 4, /, clip: float | None = 1.0, **columns: float) -> SamplerTable:
    """A sampler with the same coefficients at every step; those that are not named are zero."""
    values = {name: np.full(steps, columns.get(name, 0.0), np.float32) for name in SamplerTable.COLUMNS}
    return SamplerTable(name="ddpm", timesteps=np.arange(steps)[::-1].copy(), clip=clip, **values)


def spec(sampler: SamplerTable | None = None) -> PolicySpec:
    """Sample ``[TOKENS, WIDTH]``, one observation ``obs`` ``[CONDITIONS, WIDTH]``."""
    return PolicySpec(
        sample=(TOKENS, WIDTH),
        observations={"obs": ObservationSpec((CONDITIONS, WIDTH))},
        sampler=sampler or table(),
        chunk=ChunkSpec(action_dim=WIDTH, start=0, stop=TOKENS),
    )


class SelfAttention(nn.Module):
    """What nn.TransformerDecoderLayer does first: pre-norm, causal, packed projections, batch in the middle."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.attention = nn.LayerNorm(WIDTH), nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)
        self.mask = nn.Buffer(torch.triu(torch.full((TOKENS, TOKENS), -torch.inf), 1))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        h = self.norm(sample)
        return sample + self.attention(h, h, h, attn_mask=self.mask, need_weights=False)[0]


class CrossAttention(nn.Module):
    """The second part: keys and values from the observation."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.attention = nn.LayerNorm(WIDTH), nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + self.attention(self.norm(sample), obs, obs, need_weights=False)[0]


class FeedForward(nn.Module):
    """The third part, with the activations that policies use."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.up, self.down = nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 64), nn.Linear(64, WIDTH, bias=False)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        up = self.up(self.norm(sample))
        return sample + self.down(F.gelu(up) + F.silu(up) + F.mish(up) + F.gelu(up, approximate="tanh"))


class AdaptiveNorm(nn.Module):
    """A DiT block's gated half: timestep embedding, six-way modulation, non-affine norm, no bias."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH, elementwise_affine=False)
        self.modulate, self.mix = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH, bias=False)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        frequencies = torch.exp(torch.arange(WIDTH // 2) * -0.5)
        angles = timestep[:, None].float() * frequencies[None]
        condition = torch.cat([angles.sin(), angles.cos()], -1) + obs.mean(1)
        scale, shift, gate = self.modulate(F.silu(condition)).chunk(3, dim=-1)
        return sample + gate[:, None] * self.mix(self.norm(sample) * (1 + scale[:, None]) + shift[:, None])


class ChannelsFirst(nn.Module):
    """Convolutions over time between transpositions, and group norm."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.convolve = nn.GroupNorm(4, WIDTH), nn.Conv1d(WIDTH, WIDTH, 3, padding=1)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + F.mish(self.convolve(self.norm(sample.transpose(1, 2)))).transpose(1, 2)


class SequenceFirst(nn.Module):
    """A whole encoder layer on ``[T, B, E]``, with the observation's tokens in front."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 32, batch_first=False, norm_first=True)
        self.position = nn.Parameter(torch.randn(CONDITIONS + TOKENS, 1, WIDTH))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        tokens = torch.cat([obs, sample], 1).transpose(0, 1) + self.position
        return self.layer(tokens).transpose(0, 1)[:, CONDITIONS:]


class TwoBranches(nn.Module):
    """Rotated halves of heads, expansion over streams, boolean masks and the two streams folded into the batch."""

    def __init__(self) -> None:
        super().__init__()
        self.query, self.token = nn.Linear(WIDTH, WIDTH), nn.Parameter(torch.randn(1, 1, WIDTH))
        self.keep = nn.Buffer(torch.ones(TOKENS, TOKENS + 1, dtype=torch.bool).tril(1))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        streams = sample.shape[0]
        keys = torch.cat([self.token.expand(streams, 1, WIDTH), sample], 1)
        query = self.query(sample).view(streams, TOKENS, HEADS, -1).transpose(1, 2)
        first, second = query.chunk(2, dim=-1)
        query = torch.cat([-second, first], -1)
        keys = keys.view(streams, TOKENS + 1, HEADS, -1).transpose(1, 2)
        mixed = F.scaled_dot_product_attention(query, keys, keys, attn_mask=self.keep, scale=0.3)
        both = torch.stack([mixed.transpose(1, 2).reshape(sample.shape), sample * 0.5]).flatten(0, 1)
        both = both.softmax(-1).unflatten(0, (2, streams))
        return torch.where(both[0] > both[1], both[0], both[1] + timestep[:, None, None])


class Recurrent(nn.Module):
    """Recurrent layers over the observation; dropout between them is off."""

    def __init__(self) -> None:
        super().__init__()
        self.past = nn.GRU(WIDTH, WIDTH, 2, dropout=0.1, batch_first=True)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        _, last = self.past(obs)
        return sample + last[-1][:, None] * sample


ALL: Mapping[str, type[nn.Module]] = {
    cls.__name__: cls
    for cls in (
        SelfAttention,
        CrossAttention,
        FeedForward,
        AdaptiveNorm,
        ChannelsFirst,
        SequenceFirst,
        TwoBranches,
        Recurrent,
    )
}


@cache
def _captured(name: str) -> tuple[nn.Module, Graph, dict[str, torch.Tensor]]:
    torch.manual_seed(0)
    module = ALL[name]().eval()
    graph, weights = capture(module, spec())
    return module, graph, {name: torch.from_numpy(value) for name, value in weights.items()}


def captured(name: str) -> tuple[nn.Module, Graph, dict[str, torch.Tensor]]:
    """The module of this name with random weights, its graph, and a copy of its weights."""
    module, graph, weights = _captured(name)
    return module, graph, {name: value.clone() for name, value in weights.items()}


def random_values(types: Mapping[str, TensorType], streams: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random values of these types; integers are 0..99."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randint(0, 100, type_.at(streams), generator=generator)
        if type_.dtype == "int64"
        else torch.randn(type_.at(streams), generator=generator)
        for name, type_ in types.items()
    }
