"""Qwen3-VL as transformers has it: images in a prompt, read by its vision transformer, and by Qwen3 with the words.

An attribute's name is that of transformers' weights, but for what ``rebuilt_weights`` renames.

Sources: Bai et al., Qwen3-VL (arXiv 2511.21631); Meng et al., DeepStack (arXiv 2406.04334).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..errors import CheckpointError
from .clip import ImageTowerConfig, Layers
from .internvl import Prompt
from .language_layers import LanguageConfig, Rotation, Words, added, laid, rotation
from .saved_weights import renamed, separated
from .siglip import squares

_RENAMED = (
    (r"^visual\.patch_embed\.proj\.", "visual.embeddings.patch_embedding."),
    (r"^visual\.pos_embed\.weight$", "visual.embeddings.positions"),
    (r"^visual\.blocks\.", "visual.encoder.layers."),
    (r"^(visual\.encoder\.layers\.\d+)\.norm([12])\.", r"\1.layer_norm\2."),
    (r"^(visual\.encoder\.layers\.\d+)\.attn\.", r"\1.self_attn."),
    (r"\.self_attn\.proj\.", ".self_attn.out_proj."),
    (r"^(visual\.encoder\.layers\.\d+)\.mlp\.linear_fc", r"\1.mlp.fc"),
)


@dataclass(frozen=True)
class QwenVisionConfig(ImageTowerConfig):
    """The vision transformer, for square images of ``image_size``.

    Attributes:
        merge: patches along each axis that become one token.
        table: positions along a side that were trained; those of an image are between them.
        stacked: layers whose features are added after the first layers of the language model, too.
    """

    hidden_act: str = "gelu_pytorch_tanh"
    layer_norm_eps: float = 1e-6
    merge: int = 2
    table: int = 48
    stacked: tuple[int, ...] = ()


@dataclass(frozen=True)
class Qwen3VLConfig:
    """Sizes and variant.

    Attributes:
        text: of the language model, whose first ``text.layers`` are used.
        sections: pairs of channels whose angle is of the row, and of the column.
        base: of the rotary embedding.
    """

    vision: QwenVisionConfig
    text: LanguageConfig
    vocabulary: int
    sections: tuple[int, int]
    base: float


class _Embeddings(nn.Module):
    def __init__(self, config: QwenVisionConfig) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.patch_embedding = nn.Conv2d(3, width, patch, stride=patch)
        self.positions = nn.Parameter(torch.zeros(config.side**2, width))

    def forward(self, pixels: Tensor) -> Tensor:
        return self.patch_embedding(pixels).flatten(2).transpose(1, 2) + self.positions  # type: ignore[no-any-return]


class _Merger(nn.Module):
    """Squares of patches to tokens of the language model, normalised before or after they are put together."""

    def __init__(self, config: QwenVisionConfig, width: int, together: bool) -> None:
        super().__init__()
        whole = config.hidden_size * config.merge**2
        self.norm = nn.LayerNorm(whole if together else config.hidden_size, eps=1e-6)
        self.linear_fc1, self.linear_fc2 = nn.Linear(whole, whole), nn.Linear(whole, width)
        self.config, self.together = config, together

    def forward(self, patches: Tensor) -> Tensor:
        shape = self.config.side, self.config.merge
        read = self.norm(squares(patches, *shape)) if self.together else squares(self.norm(patches), *shape)
        return self.linear_fc2(functional.gelu(self.linear_fc1(read)))  # type: ignore[no-any-return]


class _Vision(nn.Module):
    """Pixels in -1..1 ``[N, 3, size, size]`` to tokens; after them those of each stacked layer, as more channels."""

    def __init__(self, config: QwenVisionConfig, width: int) -> None:
        super().__init__()
        self.config = config
        self.embeddings, self.encoder = _Embeddings(config), Layers(config)
        self.merger = _Merger(config, width, together=False)
        self.deepstack_merger_list = nn.ModuleList(_Merger(config, width, together=True) for _ in config.stacked)

    def forward(self, pixels: Tensor) -> Tensor:
        x, channels = self.embeddings(pixels), self.config.hidden_size // self.config.num_attention_heads
        both = torch.cartesian_prod(*(torch.arange(self.config.side, device=x.device),) * 2)[None].unbind(-1)
        row, column = (rotation(each, channels // 2) for each in both)
        turns, stacked = Rotation(*(torch.cat(pair, -1) for pair in zip(row, column, strict=True))), []
        for number, layer in enumerate(self.encoder.layers):
            x = layer(x, None, x.shape[1], turns)
            if number in self.config.stacked:
                stacked.append(self.deepstack_merger_list[self.config.stacked.index(number)](x))
        return torch.cat([self.merger(x), *stacked], -1)


class Qwen3VL(nn.Module):
    """Images and words to a feature of each token, as the last layer leaves it, not normalised.

    A prompt with more places than there are images shows them again from the first one on.
    """

    def __init__(self, config: Qwen3VLConfig, prompt: Prompt) -> None:
        super().__init__()
        self.config, self.prompt = config, prompt
        self.visual = _Vision(config.vision, config.text.width)
        self.language_model = Words(config.vocabulary, config.text)
        side, at = config.vision.side // config.vision.merge, 0
        places, pictured = list[tuple[int, int, int]](), list[bool]()
        for words in prompt.between:
            places += [(at + i,) * 3 for i in range(len(words))]
            at += len(words)
            places += [(at, at + row, at + column) for row in range(side) for column in range(side)]
            at += side
            pictured += [False] * len(words) + [True] * side**2
        self.places, self.pictured, self.after = places, pictured, at

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``[B, S, width]``, and which of them count, ``[B, S]``; ``pictured`` says which are of an image.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: what is after the last image, int64 ``[B, L]``.
            mask: bool ``[B, L]``; padding is at the end.
        """
        text, language = self.config.text, self.language_model
        seen = self.visual(torch.stack(images, 1).flatten(0, 1)).unflatten(0, (-1, len(images)))
        shown = [seen[:, place % len(images)] for place in range(len(self.prompt.between))]
        levels = list(zip(*(each.split(text.width, -1) for each in shown), strict=True))
        valid = functional.pad(mask, (len(self.places), 0), value=True)
        count = len(self.places) + tokens.shape[1]
        hidden = added(valid[:, None, None, :] & torch.ones(count, count, dtype=torch.bool, device=mask.device).tril())
        after = [(self.after + i,) * 3 for i in range(tokens.shape[1])]
        places = torch.tensor(self.places + after, device=mask.device)
        axis = torch.zeros(text.channels // 2, dtype=torch.int64)  # time, row or column, of each pair of channels
        for own, section in enumerate(self.config.sections, 1):
            axis[own : 3 * section : 3] = own
        turns = rotation(places[:, axis][None], text.channels, self.config.base)
        words = [language.embed_tokens(torch.tensor([each], device=mask.device)) for each in self.prompt.between]
        x = laid(levels[0], words, language.embed_tokens(tokens))
        blank, none = [torch.zeros_like(each) for each in words], x.new_zeros(1, tokens.shape[1], text.width)
        for number, layer in enumerate(language.layers):
            if 0 < number < len(levels):
                x = x + laid(levels[number], blank, none.expand(len(x), -1, -1))
            x = layer(x, turns, hidden)[0]
        return x, valid


def rebuilt_weights(saved: Mapping[str, Tensor], config: Qwen3VLConfig) -> dict[str, Tensor]:
    """The weights of transformers' ``Qwen3VLModel`` as ``Qwen3VL`` has them.

    An image is shown as frames that are all the same, so that patches of several become patches of one. Positions are
    those of the images' size. Queries, keys and values of an image have matrices of their own.

    Raises:
        CheckpointError: positions that are not a square of what is configured.
    """
    found = dict[str, Tensor]()
    for own, value in saved.items():
        name = renamed(own, _RENAMED)
        if name == "visual.embeddings.patch_embedding.weight" and value.ndim == 5:
            value = value.sum(2)
        elif name == "visual.embeddings.positions":
            value = _between_positions(value, config.vision)
        found |= separated(name, value) if ".qkv." in name else {name: value}
    return found


def _between_positions(table: Tensor, config: QwenVisionConfig) -> Tensor:
    """Of a square of trained positions ``[N, width]`` those of an image, bilinear; corners stay corners."""
    if len(table) != config.table**2:
        raise CheckpointError(
            f"there are {len(table)} positions of patches; expected {config.table} by {config.table}."
        )
    at = torch.linspace(0, config.table - 1, config.side)
    low = at.int()
    share, high = (at - low)[:, None, None], (low + 1).clamp(max=config.table - 1)
    grid = table.reshape(config.table, config.table, -1)
    for _ in range(2):  # rows, then columns
        grid = (grid[low] * (1 - share) + grid[high] * share).transpose(0, 1)
    return grid.flatten(0, 1)
