"""Layers of the language models Llama, Gemma and Qwen, for a prefix that is read once and an expert that reads it.

Attribute names are those under which the weights of transformers load. Keys and values are ``[B, heads, tokens,
channels]`` with every head written out, so that what depends on the prefix alone is repeated once a call.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import repeat, zip_longest
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

HIDDEN = torch.finfo(torch.float32).min
"""Added to the score of what is not seen."""


@dataclass(frozen=True)
class LanguageConfig:
    """Sizes of one language model, or of an expert that is built like one.

    Attributes:
        hidden: width inside the feed-forward layers.
        groups: heads of keys and values.
        epsilon: of the norms.
        gemma: whether it is Gemma's: norms multiply by ``1 + weight``, and the activation is GELU in place of SiLU.
        biased: whether queries, keys and values have a bias, as in Qwen2.
        whole: whether all of a layer has one, as in the vision transformer of Qwen2.5-VL.
        normed: whether each head's queries and keys are normalised, as in Qwen3.
    """

    width: int
    hidden: int
    layers: int
    heads: int
    groups: int
    channels: int
    epsilon: float = 1e-6
    gemma: bool = False
    biased: bool = False
    whole: bool = False
    normed: bool = False


class Seen(NamedTuple):
    """Keys and values of one layer, ``[B, heads, tokens, channels]`` each."""

    keys: Tensor
    values: Tensor


class Norm(nn.Module):
    """Root mean square normalisation, of the whole width or of ``channels``."""

    def __init__(self, config: LanguageConfig, channels: int | None = None) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(channels or config.width))
        self.epsilon, self.offset = config.epsilon, 1.0 if config.gemma else 0.0

    def forward(self, x: Tensor) -> Tensor:
        """``[..., width]`` -> the same."""
        scaled = x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.epsilon)
        return scaled * (self.weight + self.offset) if self.offset else scaled * self.weight


class Attention(nn.Module):
    """Projections of grouped attention; ``source`` is the width of what keys and values are made of."""

    def __init__(self, config: LanguageConfig, source: int | None = None) -> None:
        super().__init__()
        self.channels, self.groups, self.repeats = config.channels, config.groups, config.heads // config.groups
        queries, keys = config.heads * config.channels, config.groups * config.channels
        self.q_proj = nn.Linear(config.width, queries, bias=config.biased)
        self.k_proj = nn.Linear(source or config.width, keys, bias=config.biased)
        self.v_proj = nn.Linear(source or config.width, keys, bias=config.biased)
        self.o_proj = nn.Linear(queries, config.width, bias=config.whole)
        self.q_norm, self.k_norm = (Norm(config, config.channels) if config.normed else nn.Identity() for _ in range(2))

    def split(self, x: Tensor) -> Tensor:
        """``[B, T, heads * channels]`` -> ``[B, heads, T, channels]``."""
        return x.reshape(*x.shape[:2], -1, self.channels).transpose(1, 2)

    def for_all_heads(self, x: Tensor) -> Tensor:
        """``[B, groups, T, channels]`` -> ``[B, heads, T, channels]``; one group is for all heads as it is."""
        return x if 1 in (self.repeats, self.groups) else x.repeat_interleave(self.repeats, dim=1)

    def attend(self, q: Tensor, seen: Seen, mask: Tensor) -> Tensor:
        """``q [B, heads, T, channels]``, and ``mask`` that is added to the scores -> ``[B, T, width]``."""
        scores = q @ seen.keys.transpose(2, 3) * self.channels**-0.5 + mask
        return self.o_proj((scores.softmax(-1) @ seen.values).transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class FeedForward(nn.Module):
    """Gated by SiLU, or by GELU in Gemma."""

    def __init__(self, config: LanguageConfig) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(config.width, config.hidden, bias=config.whole)
        self.up_proj = nn.Linear(config.width, config.hidden, bias=config.whole)
        self.down_proj = nn.Linear(config.hidden, config.width, bias=config.whole)
        self.gemma = config.gemma

    def forward(self, x: Tensor) -> Tensor:
        """``[..., width]`` -> the same."""
        gate = self.gate_proj(x)
        gate = functional.gelu(gate, approximate="tanh") if self.gemma else functional.silu(gate)
        return self.down_proj(gate * self.up_proj(x))  # type: ignore[no-any-return]


class Layer(nn.Module):
    """One layer of the prefix."""

    def __init__(self, config: LanguageConfig) -> None:
        super().__init__()
        self.input_layernorm, self.post_attention_layernorm = Norm(config), Norm(config)
        self.self_attn, self.mlp = Attention(config), FeedForward(config)

    def forward(
        self, x: Tensor, turns: Rotation, mask: Tensor, before: Seen | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The residual stream after the layer; keys, rotated, and values ``[B, groups, T, channels]``.

        Args:
            before: those of tokens before these, which these see, too.
        """
        attention = self.self_attn
        normed = self.input_layernorm(x)
        keys = rotate(attention.k_norm(attention.split(attention.k_proj(normed))), turns)
        values = attention.split(attention.v_proj(normed))
        queries = rotate(attention.q_norm(attention.split(attention.q_proj(normed))), turns)
        seen = Seen(attention.for_all_heads(keys), attention.for_all_heads(values))
        if before is not None:  # written out by themselves, so that it is done once a call
            earlier = map(attention.for_all_heads, before)
            seen = Seen(*(torch.cat(pair, 2) for pair in zip(earlier, seen, strict=True)))
        x = x + attention.attend(queries, seen, mask)
        return x + self.mlp(self.post_attention_layernorm(x)), keys, values


class Words(nn.Module):
    """A language model but for its last norm: the embedding of its tokens, and its layers."""

    def __init__(self, vocabulary: int, config: LanguageConfig) -> None:
        super().__init__()
        self.embed_tokens = nn.Embedding(vocabulary, config.width)
        self.layers = nn.ModuleList(Layer(config) for _ in range(config.layers))


def laid(seen: Iterable[Tensor], words: Iterable[Tensor | None], last: Tensor) -> Tensor:
    """A prompt ``[B, S, width]``: words before each image, what is of the image, and what is after the last one.

    Args:
        seen: ``[B, tokens, width]`` of each image; of fewer than there are places for, the others are left out.
        words: before each place, ``[1, n, width]``, or None.
        last: ``[B, L, width]``.
    """
    parts = [last]
    for own, image in zip_longest(words, seen):
        parts[-1:-1] = [] if own is None else [own.expand(len(last), -1, -1)]
        parts[-1:-1] = [] if image is None else [image]
    return torch.cat(parts, 1)


def read_prefix(
    layers: Iterable[nn.Module], x: Tensor, turns: Rotation, mask: Tensor, before: Iterable[Seen | None] = repeat(None)
) -> list[Tensor]:
    """Keys and values of every layer, in turn, ``[B, groups, T, channels]``; what nobody reads is not part of a graph.

    Args:
        layers: of the language model.
        x: the tokens, embedded, ``[B, T, width]``.
        turns: of their positions.
        mask: added to the scores, ``[B, 1, T, T]``, or ``[B, 1, T, before + T]``.
        before: of each layer, keys and values of tokens before these, which these see, too.
    """
    found = []
    for layer, earlier in zip(layers, before, strict=False):
        x, keys, values = layer(x, turns, mask, earlier)
        found += [keys, values]
    return found


def prefix_mask(valid: Tensor, late: int = 0) -> Tensor:
    """What tokens of a prefix see of each other, to be added to scores ``[B, 1, T, T]``.

    Args:
        valid: bool ``[B, T]``; padding is not seen. What it sees itself nobody reads.
        late: the last so many tokens are not seen by those before them.
    """
    count = valid.shape[1]
    group = torch.arange(count, device=valid.device) >= count - late
    seen = valid[:, None, None, :] & (group[None, :] <= group[:, None])
    return added(seen)


def added(seen: Tensor) -> Tensor:
    """A mask, True for what is seen, as a number that is added to scores."""
    return torch.where(seen, 0.0, HIDDEN)


class Rotation(NamedTuple):
    """Cosine and sine of the rotary embedding's angles, ``[B, 1, T, channels / 2]`` each."""

    cos: Tensor
    sin: Tensor


def rounded_rates(channels: int, base: float = 10_000) -> Tensor:
    """Frequencies of the rotary embedding as a model has them that was cast to bfloat16, as float32."""
    made = 1.0 / (base ** (torch.arange(0, channels, 2, dtype=torch.float32, device="cpu") / channels))
    return made.to(torch.bfloat16).to(torch.float32)


def rotation(positions: Tensor, channels: int, base: float = 10_000, rates: Tensor | None = None) -> Rotation:
    """The rotary embedding of positions ``[B, T]``; of several axes, ``[B, T, channels / 2]``.

    Args:
        rates: its frequencies, where they are others than ``base`` says.
    """
    if rates is None:
        rates = base ** (-2.0 / channels * torch.arange(channels // 2, dtype=torch.float32, device=positions.device))
    own = positions if positions.ndim == 3 else positions[..., None]
    angles = (own.to(torch.float32) * rates)[:, None]
    return Rotation(angles.cos(), angles.sin())


def rotate(x: Tensor, by: Rotation) -> Tensor:
    """Rotary embedding of ``[B, heads, T, channels]``; the halves of the channels are the pairs."""
    left, right = x.chunk(2, -1)
    cos, sin = by
    return torch.cat([left * cos - right * sin, right * cos + left * sin], -1)


def angles(timestep: Tensor, count: int, last: int, longest: float = 10_000) -> Tensor:
    """A time ``[B]`` times falling rates, ``[B, count]``: 1 at first, and ``1 / longest`` after ``last`` others."""
    falling = torch.arange(count, dtype=torch.float32, device=timestep.device) * (-math.log(longest) / last)
    return timestep[:, None] * torch.exp(falling)


def waves(timestep: Tensor, width: int, shortest: float, longest: float) -> Tensor:
    """Sine and cosine of a time ``[B]``, ``[B, width]``; periods between the two, evenly spaced in their logarithm."""
    fraction = torch.linspace(0.0, 1.0, width // 2, dtype=torch.float64, device=timestep.device)
    rates = 1.0 / (shortest * (longest / shortest) ** fraction) * 2 * torch.pi
    angle = rates * timestep[:, None]
    return torch.cat([angle.sin(), angle.cos()], -1).to(torch.float32)
