"""Qwen2.5-VL as transformers has it: images, words and a state in a prompt, for actions that are denoised after it.

An attribute's name is that of transformers' weights, but for what ``rebuilt_weights`` renames.

Source: Bai et al., Qwen2.5-VL (arXiv 2502.13923).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.frontends.saved_weights import renamed, separated

from . import language_layers as layers
from .qwen3_vl import seen_by
from .siglip import squares

Piece = tuple[int, ...] | Literal["image", "state", "task"]
"""Of a prompt: tokens that are always the same, or what a call brings: the next image, the state, the instruction."""

_RENAMED = (
    (r"^visual\.patch_embed\.proj\.", "visual.patch_embed."),
    (r"^(visual\.blocks\.\d+)\.norm1\.", r"\1.input_layernorm."),
    (r"^(visual\.blocks\.\d+)\.norm2\.", r"\1.post_attention_layernorm."),
    (r"^(visual\.blocks\.\d+)\.attn\.", r"\1.self_attn."),
    (r"\.self_attn\.proj\.", ".self_attn.o_proj."),
)


@dataclass(frozen=True)
class Qwen25VLConfig:
    """Sizes and variant.

    Attributes:
        vision: of the layers of the vision transformer.
        patch: pixels along a side of a patch.
        merge: patches along each axis that become one token.
        window: such tokens along a side of the square that a layer's attention is confined to.
        whole: layers of the vision transformer whose attention is not confined.
        text: of the language model.
        sections: pairs of channels whose angle is of the time, the row and the column.
        base: of the rotary embedding.
        grids: rows and columns of patches of each camera's images.
        rounded: whether frequencies of rotary positions are rounded to bfloat16, as a model has them that was cast to
            it as a whole; and with them cosines and sines of places in an image, which are computed in it.
    """

    vision: layers.LanguageConfig
    patch: int
    merge: int
    window: int
    whole: frozenset[int]
    text: layers.LanguageConfig
    vocabulary: int
    sections: tuple[int, int, int]
    base: float
    grids: tuple[tuple[int, int], ...] = ()
    rounded: bool = False

    def of_images(self, sizes: Sequence[tuple[int, int]]) -> "Qwen25VLConfig":
        """The same for cameras whose images have these heights and widths, as the vision transformer sees them."""
        return replace(self, grids=tuple((height // self.patch, width // self.patch) for height, width in sizes))


class Read(NamedTuple):
    """What is left of a prompt for the tokens after it.

    Attributes:
        valid: which of its tokens count, bool ``[B, P]``.
        after: the position after its last token, int64 ``[B, 1]``.
        cache: keys and values of every layer, in turn, ``[B, groups, P, channels]``.
    """

    valid: Tensor
    after: Tensor
    cache: tuple[Tensor, ...]


class _Merger(nn.Module):
    """Squares of patches to tokens of the language model."""

    def __init__(self, config: Qwen25VLConfig) -> None:
        super().__init__()
        inside = config.vision.width * config.merge**2
        self.ln_q, self.merge = layers.Norm(config.vision), config.merge
        self.mlp = nn.Sequential(nn.Linear(inside, inside), nn.GELU(), nn.Linear(inside, config.text.width))

    def forward(self, patches: Tensor, rows: int) -> Tensor:
        return self.mlp(squares(self.ln_q(patches), rows, self.merge))  # type: ignore[no-any-return]


def _frequencies(channels: int, base: float, rounded: bool) -> Tensor:
    """Angles of position 1, ``[channels / 2]``; made of numbers, so that a network on the meta device has them, too."""
    made = 1.0 / base ** (torch.arange(0, channels, 2, dtype=torch.float32, device="cpu") / channels)
    # Nobody saves them, and yet a cast of the model rounds them: what was trained so knows no others. At position 300
    # that turns a channel by up to a third of a radian, which no rounding of activations does.
    return made.to(torch.bfloat16) if rounded else made


class _Block(layers.Layer):
    """A layer of the vision transformer."""

    def forward(self, x: Tensor, turns: layers.Rotation, mask: Tensor | None) -> Tensor:  # type: ignore[override]
        attention, normed = self.self_attn, self.input_layernorm(x)
        projections = attention.q_proj, attention.k_proj, attention.v_proj
        queries, keys, values = (attention.split(project(normed)) for project in projections)
        queries, keys = layers.rotate(queries, turns), layers.rotate(keys, turns)
        mixed = functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
        x = x + attention.o_proj(mixed.transpose(1, 2).flatten(2))
        return x + self.mlp(self.post_attention_layernorm(x))  # type: ignore[no-any-return]


class _Vision(nn.Module):
    """Normalised pixels ``[N, 3, H, W]`` to tokens ``[N, tokens, width]``."""

    cosines: Tensor
    sines: Tensor

    def __init__(self, config: Qwen25VLConfig) -> None:
        super().__init__()
        self.config = config
        frequencies = _frequencies(config.vision.channels // 2, 1e4, config.rounded)
        longest = max((side for grid in config.grids for side in grid), default=1)
        angles = torch.arange(longest, device="cpu").to(frequencies)[:, None] * frequencies
        self.register_buffer("cosines", angles.cos().to(torch.float32), persistent=False)
        self.register_buffer("sines", angles.sin().to(torch.float32), persistent=False)
        self.patch_embed = nn.Conv2d(3, config.vision.width, config.patch, stride=config.patch, bias=False)
        self.blocks = nn.ModuleList(_Block(config.vision) for _ in range(config.vision.layers))
        self.merger = _Merger(config)

    def forward(self, pixels: Tensor) -> Tensor:
        config, patches = self.config, self.patch_embed(pixels)
        rows, columns = patches.shape[2:]
        places = torch.cartesian_prod(
            torch.arange(rows, device=pixels.device), torch.arange(columns, device=pixels.device)
        )
        turns = layers.Rotation(*(table[places].flatten(1)[None, None] for table in (self.cosines, self.sines)))
        window = places // (config.window * config.merge)
        confined = layers.added((window[:, None] == window[None]).all(-1))[None, None]
        x = patches.flatten(2).transpose(1, 2)
        for number, block in enumerate(self.blocks):
            x = block(x, turns, None if number in config.whole else confined)
        return self.merger(x, rows)  # type: ignore[no-any-return]


class _Language(layers.Words):
    def __init__(self, config: Qwen25VLConfig) -> None:
        super().__init__(config.vocabulary, config.text)
        self.norm = layers.Norm(config.text)


class Qwen25VL(nn.Module):
    """Both transformers. ``read`` is the prompt, and ``answered`` what comes of tokens after it."""

    frequencies: Tensor

    def __init__(self, config: Qwen25VLConfig, prompt: Sequence[Piece]) -> None:
        super().__init__()
        self.config, self.prompt = config, tuple(prompt)
        self.visual, self.language_model = _Vision(config), _Language(config)
        frequencies = _frequencies(config.text.channels, config.base, config.rounded).to(torch.float32)
        self.register_buffer("frequencies", frequencies, persistent=False)

    def read(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> Read:
        """The prompt.

        Args:
            images: of each camera ``[B, 3, H, W]``, normalised.
            tokens: of the instruction, int64 ``[B, L]``.
            mask: bool ``[B, L]``; padding is at the end.
            state: as a token, ``[B, width]``.
        """
        language, batch, device = self.language_model, len(mask), mask.device
        grids = iter(self.config.grids)
        pictures = iter(seen_by(self.visual, images, self.config.grids))
        parts, places, valid = [], list[Tensor](), list[Tensor]()
        # Numbers until the instruction, of which nobody knows before the call how long it is.
        at: Any = 0
        count: Any
        for piece in self.prompt:
            if piece == "image":
                parts.append(next(pictures))
                rows, columns = (side // self.config.merge for side in next(grids))
                sides = (torch.arange(side, device=device) for side in (1, rows, columns))
                own, count = torch.cartesian_prod(*sides), max(rows, columns)
            elif piece == "state":
                parts.append(state[:, None])
                own, count = torch.zeros(1, 3, dtype=torch.int64, device=device), 1
            else:
                words = tokens if piece == "task" else torch.tensor([piece], device=device)
                parts.append(language.embed_tokens(words).expand(batch, -1, -1))
                own = torch.arange(words.shape[1], device=device)[:, None].expand(-1, 3)
                count = mask.sum(1)[:, None, None] if piece == "task" else words.shape[1]
            places.append((at + own[None]).expand(batch, -1, -1))
            valid.append(mask if piece == "task" else torch.ones(batch, len(own), dtype=torch.bool, device=device))
            at = at + count
        seen = torch.cat(valid, 1)
        causal = torch.ones(seen.shape[1], seen.shape[1], dtype=torch.bool, device=device).tril()
        axis = [number for number, section in enumerate(self.config.sections) for _ in range(section)]
        turns = self._turned(torch.cat(places, 1)[..., axis])
        hidden = layers.added(seen[:, None, None, :] & causal)
        cache = layers.read_prefix(language.layers, torch.cat(parts, 1), turns, hidden)
        return Read(seen, at[:, 0], tuple(cache))

    def answered(self, x: Tensor, read: Read, mask: Tensor, own: Iterable[nn.Module] | None = None) -> Tensor:
        """What the language model makes of tokens ``[B, T, width]`` after the prompt, normalised.

        Args:
            mask: whether a token sees another of these, bool ``[T, T]``.
            own: layers for these tokens, where they are not those that read the prompt.
        """
        turns, hidden = self._after(x, read, mask)
        for number, layer in enumerate(own or self.language_model.layers):
            x = layer(x, turns, hidden, layers.Seen(*read.cache[2 * number : 2 * number + 2]))[0]
        return self.language_model.norm(x)  # type: ignore[no-any-return]

    def _after(self, x: Tensor, read: Read, mask: Tensor) -> tuple[layers.Rotation, Tensor]:
        """The rotation of tokens after the prompt, and what is added to their scores ``[B, 1, T, P + T]``."""
        count = x.shape[1]
        turns = self._turned((read.after + torch.arange(count, device=x.device))[..., None])
        seen = read.valid[:, None, None].expand(-1, -1, count, -1)
        own = mask[None, None].expand(len(seen), -1, -1, -1)
        return turns, layers.added(torch.cat([seen, own], -1))

    def _turned(self, places: Tensor) -> layers.Rotation:
        """The rotation of positions ``[B, T, channels / 2]``, or ``[B, T, 1]``."""
        angles = (places.to(torch.float32) * self.frequencies)[:, None]
        return layers.Rotation(angles.cos(), angles.sin())


def rebuilt_weights(saved: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of transformers' ``Qwen2_5_VLModel`` as ``Qwen25VL`` has them.

    An image is shown as frames that are all the same, so that patches of several become patches of one. Queries, keys
    and values of an image have matrices of their own.
    """
    found = dict[str, Tensor]()
    for own, value in saved.items():
        name = renamed(own, _RENAMED)
        if name == "visual.patch_embed.weight" and value.ndim == 5:
            value = value.sum(2)
        found |= separated(name, value) if ".qkv." in name else {name: value}
    return found
