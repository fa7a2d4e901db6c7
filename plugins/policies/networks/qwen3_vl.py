"""Qwen3-VL as transformers has it: images in a prompt, read by its vision transformer, and by Qwen3 with the words.

An attribute's name is that of transformers' weights, but for what ``rebuilt_weights`` renames.

Sources: Bai et al., Qwen3-VL (arXiv 2511.21631); Meng et al., DeepStack (arXiv 2406.04334).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import renamed, separated

from .clip import ImageTowerConfig, Layers
from .internvl import Prompt
from .language_layers import LanguageConfig, Rotation, Words, added, laid, rotation
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
    """The vision transformer, for images of any size in whole squares of patches.

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
        grids: rows and columns of patches of each camera's images.
    """

    vision: QwenVisionConfig
    text: LanguageConfig
    vocabulary: int
    sections: tuple[int, int]
    base: float
    grids: tuple[tuple[int, int], ...]


def _named(rows: int, columns: int) -> str:
    return f"{rows}x{columns}"


class _Embeddings(nn.Module):
    def __init__(self, config: Qwen3VLConfig) -> None:
        super().__init__()
        width, patch = config.vision.hidden_size, config.vision.patch_size
        self.patch_embedding = nn.Conv2d(3, width, patch, stride=patch)
        grids = dict.fromkeys(config.grids)
        made = {_named(*each): nn.Parameter(torch.zeros(math.prod(each), width)) for each in grids}
        self.positions = nn.ParameterDict(made)

    def forward(self, pixels: Tensor) -> tuple[Tensor, int, int]:
        patches = self.patch_embedding(pixels)
        rows, columns = patches.shape[2:]
        return patches.flatten(2).transpose(1, 2) + self.positions[_named(rows, columns)], rows, columns


class _Merger(nn.Module):
    """Squares of patches to tokens of the language model, normalised before or after they are put together."""

    def __init__(self, config: QwenVisionConfig, width: int, together: bool) -> None:
        super().__init__()
        whole = config.hidden_size * config.merge**2
        self.norm = nn.LayerNorm(whole if together else config.hidden_size, eps=1e-6)
        self.linear_fc1, self.linear_fc2 = nn.Linear(whole, whole), nn.Linear(whole, width)
        self.merge, self.together = config.merge, together

    def forward(self, patches: Tensor, rows: int) -> Tensor:
        shape = rows, self.merge
        read = self.norm(squares(patches, *shape)) if self.together else squares(self.norm(patches), *shape)
        return self.linear_fc2(functional.gelu(self.linear_fc1(read)))  # type: ignore[no-any-return]


class _Vision(nn.Module):
    """Pixels in -1..1 ``[N, 3, H, W]`` to tokens; after them those of each stacked layer, as more channels."""

    def __init__(self, whole: Qwen3VLConfig) -> None:
        super().__init__()
        config, width = whole.vision, whole.text.width
        self.config = config
        self.embeddings, self.encoder = _Embeddings(whole), Layers(config)
        self.merger = _Merger(config, width, together=False)
        self.deepstack_merger_list = nn.ModuleList(_Merger(config, width, together=True) for _ in config.stacked)

    def forward(self, pixels: Tensor) -> Tensor:
        channels = self.config.hidden_size // self.config.num_attention_heads
        x, *grid = self.embeddings(pixels)
        both = torch.cartesian_prod(*(torch.arange(side, device=x.device) for side in grid))[None].unbind(-1)
        row, column = (rotation(each, channels // 2) for each in both)
        turns, stacked = Rotation(*(torch.cat(pair, -1) for pair in zip(row, column, strict=True))), []
        for number, layer in enumerate(self.encoder.layers):
            x = layer(x, None, x.shape[1], turns)
            if number in self.config.stacked:
                stacked.append(self.deepstack_merger_list[self.config.stacked.index(number)](x, grid[0]))
        return torch.cat([self.merger(x, grid[0]), *stacked], -1)


class Qwen3VL(nn.Module):
    """Images and words to a feature of each token, as the last layer leaves it, not normalised.

    Those of the prompt's ``later`` are the last. A prompt with more places than there are images shows them again from
    the first one on.
    """

    def __init__(self, config: Qwen3VLConfig, prompt: Prompt) -> None:
        super().__init__()
        self.config, self.prompt = config, prompt
        self.visual = _Vision(config)
        self.language_model = Words(config.vocabulary, config.text)
        at, places, pictured = 0, list[tuple[int, int, int]](), list[bool]()
        for place, words in enumerate(prompt.between):
            rows, columns = (side // config.vision.merge for side in config.grids[place % len(config.grids)])
            places += [(at + i,) * 3 for i in range(len(words))]
            at += len(words)
            places += [(at, at + row, at + column) for row in range(rows) for column in range(columns)]
            at += max(rows, columns)
            pictured += [False] * len(words) + [True] * (rows * columns)
        self.places, self.pictured, self.after = places, pictured, at

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``[B, S, width]``, and which of them count, ``[B, S]``; ``pictured`` says which are of an image.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: what is after the last image, int64 ``[B, L]``.
            mask: bool ``[B, L]``; padding is at the end.
        """
        config, language, later = self.config, self.language_model, self.prompt.later
        seen, channels = seen_by(self.visual, images, config.grids), config.text.channels // 2
        shown = [seen[place % len(images)] for place in range(len(self.prompt.between))]
        levels = list(zip(*(each.chunk(1 + len(config.vision.stacked), -1) for each in shown), strict=True))
        valid = functional.pad(mask, (len(self.places), len(later)), value=True)
        count = valid.shape[1]
        hidden = added(valid[:, None, None, :] & torch.ones(count, count, dtype=torch.bool, device=mask.device).tril())
        after = [(self.after + i,) * 3 for i in range(tokens.shape[1])]
        places = torch.tensor(self.places + after, device=mask.device)
        axis = torch.zeros(channels, dtype=torch.int64)  # time, row or column, of each pair of channels
        for own_axis, section in enumerate(config.sections, 1):
            axis[own_axis : 3 * section : 3] = own_axis
        placed, last = places[:, axis][None], language.embed_tokens(tokens)
        if later:  # they come right after what counts of the words
            own_places = self.after + mask.sum(1, keepdim=True) + torch.arange(len(later), device=mask.device)
            placed = torch.cat([placed.expand(len(mask), -1, -1), own_places[..., None].expand(-1, -1, channels)], 1)
            told = language.embed_tokens(torch.tensor([later], device=mask.device))
            last = torch.cat([last, told.expand(len(mask), -1, -1)], 1)
        turns = rotation(placed, config.text.channels, config.base)
        words = [language.embed_tokens(torch.tensor([each], device=mask.device)) for each in self.prompt.between]
        x = laid(levels[0], words, last)
        blank, none = [torch.zeros_like(each) for each in words], x.new_zeros(1, last.shape[1], config.text.width)
        for number, layer in enumerate(language.layers):
            if 0 < number < len(levels):
                x = x + laid(levels[number], blank, none.expand(len(x), -1, -1))
            x = layer(x, turns, hidden)[0]
        return x, valid


def seen_by(visual: nn.Module, images: list[Tensor], grids: tuple[tuple[int, int], ...]) -> list[Tensor]:
    """What a vision transformer makes of each camera's images; those of one grid go through it together."""
    seen = dict[int, Tensor]()
    for grid in dict.fromkeys(grids):
        own = [camera for camera, each in enumerate(grids) if each == grid]
        made = visual(torch.stack([images[camera] for camera in own], 1).flatten(0, 1))
        seen |= dict(zip(own, made.unflatten(0, (-1, len(own))).unbind(1), strict=True))
    return [seen[camera] for camera in range(len(grids))]


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
            grids = dict.fromkeys(config.grids)
            found |= {f"{name}.{_named(*each)}": _between_positions(value, config.vision.table, each) for each in grids}
            continue
        found |= separated(name, value) if ".qkv." in name else {name: value}
    return found


def _between_positions(table: Tensor, side: int, grid: tuple[int, int]) -> Tensor:
    """Of a square of trained positions ``[N, width]`` those of an image, bilinear; corners stay corners."""
    if len(table) != side**2:
        raise CheckpointError(f"there are {len(table)} positions of patches; expected {side} by {side}.")
    made = table.reshape(side, side, -1)
    for count in grid:  # rows, then columns
        at = torch.linspace(0, side - 1, count)
        low = at.int()
        share, high = (at - low)[:, None, None], (low + 1).clamp(max=side - 1)
        made = (made[low] * (1 - share) + made[high] * share).transpose(0, 1)
    return made.flatten(0, 1)
