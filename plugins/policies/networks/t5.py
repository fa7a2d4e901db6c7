"""T5's encoder of words; modules are called as in transformers. Source: Raffel et al. (arXiv 1910.10683)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from .layers import split

_EPSILON = 1e-6
_FURTHEST = 128
"""Distance between two words from which on it tells no larger one."""


@dataclass(frozen=True)
class Words:
    """Of T5's encoder.

    Attributes:
        name: of its tokenizer in the policy.
        length: tokens of an instruction, with its padding.
        inside: width of all heads together.
        buckets: of distances between words.
    """

    name: str
    length: int
    vocabulary: int
    width: int
    hidden: int
    layers: int
    heads: int
    inside: int
    buckets: int


class _WordAttention(nn.Module):
    def __init__(self, words: Words, first: bool) -> None:
        super().__init__()
        self.heads = words.heads
        self.q, self.k, self.v = (nn.Linear(words.width, words.inside, bias=False) for _ in range(3))
        self.o = nn.Linear(words.inside, words.width, bias=False)
        if first:  # all layers have its bias
            self.relative_attention_bias = nn.Embedding(words.buckets, words.heads)

    def forward(self, x: Tensor, bias: Tensor) -> Tensor:
        q, k, v = (split(each(x), self.heads) for each in (self.q, self.k, self.v))
        weights = (q @ k.transpose(-1, -2) + bias).softmax(-1)  # without a scale
        return self.o((weights @ v).transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class _WordLayer(nn.Module):
    def __init__(self, words: Words, first: bool) -> None:
        super().__init__()
        self.layer = nn.ModuleList([nn.Module(), nn.Module()])
        attention, feed = self.layer
        attention.SelfAttention, attention.layer_norm = _WordAttention(words, first), nn.RMSNorm(words.width, _EPSILON)
        feed.DenseReluDense, feed.layer_norm = nn.Module(), nn.RMSNorm(words.width, _EPSILON)
        feed.DenseReluDense.wi = nn.Linear(words.width, words.hidden, bias=False)
        feed.DenseReluDense.wo = nn.Linear(words.hidden, words.width, bias=False)

    def forward(self, x: Tensor, bias: Tensor) -> Tensor:
        attention, feed = self.layer
        x = x + attention.SelfAttention(attention.layer_norm(x), bias)  # type: ignore[operator]
        inner = feed.DenseReluDense.wi(feed.layer_norm(x)).relu()  # type: ignore[operator, union-attr]
        return x + feed.DenseReluDense.wo(inner)  # type: ignore[operator, union-attr, no-any-return]


class T5(nn.Module):
    """Its encoder."""

    def __init__(self, words: Words) -> None:
        super().__init__()
        self.shared = nn.Embedding(words.vocabulary, words.width)
        self.encoder = nn.Module()
        self.encoder.block = nn.ModuleList(_WordLayer(words, not i) for i in range(words.layers))
        self.encoder.final_layer_norm = nn.RMSNorm(words.width, _EPSILON)

    def forward(self, tokens: Tensor, mask: Tensor, distances: Tensor) -> Tensor:
        """``[B, L]``, which of them count, and ``word_distances`` to ``[B, L, E]``."""
        first: Any = self.encoder.block[0].layer[0].SelfAttention  # type: ignore[index, union-attr]
        bias = first.relative_attention_bias(distances).permute(2, 0, 1)[None]
        bias = torch.where(mask[:, None, None], bias, torch.finfo(torch.float32).min)
        x = self.shared(tokens)
        for layer in self.encoder.block:  # type: ignore[union-attr]
            x = layer(x, bias)
        return self.encoder.final_layer_norm(x)  # type: ignore[operator, no-any-return]


def word_distances(length: int, buckets: int) -> Tensor:
    """The bucket of each pair of words, int64 ``[L, L]``; half of them are for words behind, and far ones are wider."""
    half = buckets // 2
    distance = torch.arange(length)[None] - torch.arange(length)[:, None]
    behind, distance = (distance > 0) * half, distance.abs()
    exact = half // 2
    wide = torch.log(distance.clamp(min=1) / exact) / math.log(_FURTHEST / exact) * (half - exact)
    return behind + torch.where(distance < exact, distance, (exact + wide.long()).clamp(max=half - 1))
