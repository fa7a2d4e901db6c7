"""What makes a few tokens of the many of a picture: Dita's Q-former, and the Perceiver resampler of OpenFlamingo.

Parameters are called as in the originals: ``scripts/vision_tokenizers/qformer.py`` of RoboDita/Dita, after BLIP-2
(arXiv 2301.12597) with FiLM (arXiv 1709.07871), and ``flamingo_pytorch`` 0.1.2 (arXiv 2204.14198).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import TimmAttention, TimmMlp, split

CHANNELS = 64
"""Of a head, whatever the width is."""


class _CrossAttention(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.count = width // CHANNELS
        self.q, self.kv = nn.Linear(width, width, bias=False), nn.Linear(width, 2 * width, bias=False)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, seen: Tensor) -> Tensor:
        q, k, v = (split(each, self.count) for each in (self.q(x), *self.kv(seen).chunk(2, -1)))
        mixed = functional.scaled_dot_product_attention(q, k, v)
        return self.proj(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class _Film(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self._projection_add, self._projection_mult = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor, words: Tensor) -> Tensor:
        """``[B, F, Q, E]`` and ``[B, E]`` -> ``[B, F, Q, E]``."""
        scale, shift = (each(words)[:, None, None] for each in (self._projection_mult, self._projection_add))
        return (1 + scale) * x + shift  # type: ignore[no-any-return]


class _Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm1_1, self.norm2 = (nn.LayerNorm(width) for _ in range(3))
        self.self_attn = TimmAttention(width, width // CHANNELS, biased=False)
        self.cross_attn, self.mlp = _CrossAttention(width), TimmMlp(width, exact=True)
        self.film_layer = _Film(width)

    def forward(self, x: Tensor, seen: Tensor, words: Tensor, frames: int) -> Tensor:
        x = x + self.self_attn(self.norm1(x))
        x = x + self.cross_attn(self.norm1_1(x), seen)
        x = x + self.mlp(self.norm2(x))
        by_stream: Tensor = torch.unflatten(x, 0, (-1, frames))
        return self.film_layer(by_stream, words).flatten(0, 1)  # type: ignore[no-any-return]


class QFormer(nn.Module):
    """Features of pictures ``[B * F, P, width]`` and one of the words ``[B, width]`` to ``[B * F, Q, width]``.

    Args:
        frames: F, pictures of one stream, which have its words.
    """

    def __init__(self, width: int, depth: int, queries: int, frames: int) -> None:
        super().__init__()
        self.queries, self.frames = nn.Parameter(torch.zeros(1, queries, width)), frames
        self.blocks = nn.ModuleList(_Block(width) for _ in range(depth))
        self.norm = nn.LayerNorm(width)

    def forward(self, seen: Tensor, words: Tensor) -> Tensor:
        """See the class."""
        x = self.queries.expand(seen.shape[0], -1, -1)
        for block in self.blocks:
            x = block(x, seen, words, self.frames)
        return self.norm(x)  # type: ignore[no-any-return]


class _Perceived(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.count = width // CHANNELS
        self.norm_media, self.norm_latents = nn.LayerNorm(width), nn.LayerNorm(width)
        self.to_q, self.to_kv = nn.Linear(width, width, bias=False), nn.Linear(width, 2 * width, bias=False)
        self.to_out = nn.Linear(width, width, bias=False)

    def forward(self, seen: Tensor, x: Tensor) -> Tensor:
        x = self.norm_latents(x)
        both = self.to_kv(torch.cat([self.norm_media(seen), x], 1)).chunk(2, -1)
        q, k, v = (split(each, self.count) for each in (self.to_q(x), *both))
        mixed = functional.scaled_dot_product_attention(q, k, v)
        return self.to_out(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class Resampler(nn.Module):
    """Features of pictures ``[N, P, width]`` to ``[N, Q, width]``; it reads no words.

    Args:
        places: rows of the table of positions in time, of which the first one is used: each picture is alone.
    """

    def __init__(self, width: int, depth: int, queries: int, places: int) -> None:
        super().__init__()
        self.latents = nn.Parameter(torch.zeros(queries, width))
        self.media_pos_emb = nn.Parameter(torch.zeros(places, 1, width))
        self.layers = nn.ModuleList(nn.ModuleList([_Perceived(width), _feed_forward(width)]) for _ in range(depth))
        self.norm = nn.LayerNorm(width)

    def forward(self, seen: Tensor, words: Tensor) -> Tensor:
        """See the class."""
        seen = seen + self.media_pos_emb[0]
        x = self.latents.expand(seen.shape[0], -1, -1)
        for layer in self.layers:
            attend, feed = layer.children()
            x = attend(seen, x) + x
            x = feed(x) + x
        return self.norm(x)  # type: ignore[no-any-return]


def _feed_forward(width: int) -> nn.Sequential:
    inside = 4 * width
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, inside, bias=False), nn.GELU(), nn.Linear(inside, width, bias=False)
    )
