"""Florence-2 as transformers has it: DaViT makes tokens of an image, BART's encoder reads them with the instruction.

An attribute's name is that of transformers' weights, but for those that ``lerobot.xvla`` renames.

Sources: Xiao et al., Florence-2 (arXiv 2311.06242); Ding et al., DaViT (arXiv 2204.03645).
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .clip import Attention, FeedForward, TowerConfig
from .internvl import Colours


@dataclass(frozen=True)
class BartConfig(TowerConfig):
    """The encoder of words.

    Attributes:
        scaled: whether embeddings of words are multiplied by the root of the width.
    """

    vocab_size: int = 50265
    max_position_embeddings: int = 1024
    scaled: bool = False


@dataclass(frozen=True)
class Stage:
    """One stage of DaViT.

    Attributes:
        tower: width, layers, heads of attention within windows, and width inside of feed-forward.
        groups: of attention between channels.
        kernel: of the convolution that makes its patches, with ``stride`` and ``padding``.
        normed: whether what it reads is normalised, rather than what it makes.
    """

    tower: TowerConfig
    groups: int
    kernel: int
    stride: int
    padding: int
    normed: bool

    def reduced(self, pixels: int) -> int:
        """Patches along a side of so many pixels, or patches of the stage before."""
        return (pixels + 2 * self.padding - self.kernel) // self.stride + 1


@dataclass(frozen=True)
class FlorenceConfig:
    """Sizes and variant.

    Attributes:
        window: patches along a side of a window.
        positions: rows, and columns, that have an embedding.
        moments: rows of the embedding of time, of which the first one is read.
        size: height and width of the images.
        colours: of each camera, whether pixels are normalised by the mean and the deviation of ImageNet.
    """

    stages: tuple[Stage, ...]
    text: BartConfig
    window: int
    positions: int
    moments: int
    size: tuple[int, int]
    colours: tuple[bool, ...]

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches after the last stage."""
        height, width = self.size
        for stage in self.stages:
            height, width = stage.reduced(height), stage.reduced(width)
        return height, width

    @property
    def image_tokens(self) -> int:
        """Tokens of one image: its patches, and before them their mean."""
        return self.grid[0] * self.grid[1] + 1


class _Patches(nn.Module):
    def __init__(self, stage: Stage, before: int) -> None:
        super().__init__()
        width = stage.tower.hidden_size
        self.conv = nn.Conv2d(before, width, stage.kernel, stride=stage.stride, padding=stage.padding)
        self.norm, self.first = nn.LayerNorm(before if stage.normed else width), stage.normed

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(self._normed(x)) if self.first else self._normed(self.conv(x))

    def _normed(self, x: Tensor) -> Tensor:
        return self.norm(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)  # type: ignore[no-any-return]


class _Windows(Attention):
    """Patches look at those of their window; what is missing of a window at the border is zeros, and is seen."""

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__(width, heads)
        self.window = window

    def within(self, x: Tensor, height: int, width: int) -> Tensor:
        """``[N, height * width, C]`` -> the same."""
        side = self.window
        below, right = -height % side, -width % side
        rows, columns = (height + below) // side, (width + right) // side
        grid: Any = functional.pad(torch.unflatten(x, 1, (height, width)), (0, 0, 0, right, 0, below))
        cut = grid.unflatten(2, (columns, side)).unflatten(1, (rows, side)).transpose(2, 3)
        cut = cut.flatten(3, 4).flatten(0, 2)
        seen = self(cut, cut, None)
        grid = seen.unflatten(1, (side, side)).unflatten(0, (-1, rows, columns)).transpose(2, 3)
        grid = grid.flatten(3, 4).flatten(1, 2)
        return grid[:, :height, :width].flatten(1, 2)  # type: ignore[no-any-return]


class _Channels(Attention):
    """Channels look at those of their group."""

    def within(self, x: Tensor, height: int, width: int) -> Tensor:
        """``[N, height * width, C]`` -> the same."""
        shape = (self.heads, x.shape[2] // self.heads)
        q, k, v = (each(x).unflatten(2, shape).permute(0, 2, 3, 1) for each in (self.q_proj, self.k_proj, self.v_proj))
        mixed = functional.scaled_dot_product_attention(q, k, v)  # scaled by the number of patches
        return self.out_proj(mixed.permute(0, 3, 1, 2).flatten(2))  # type: ignore[no-any-return]


class _Half(nn.Module):
    """Convolution, attention, convolution, feed-forward, each added."""

    def __init__(self, config: TowerConfig, attention: _Windows | _Channels) -> None:
        super().__init__()
        width = config.hidden_size
        self.conv1, self.conv2 = (nn.Conv2d(width, width, 3, padding=1, groups=width) for _ in range(2))
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.self_attn, self.ffn = attention, FeedForward(config)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[2:]
        rows = (self.conv1(x) + x).flatten(2).transpose(1, 2)
        rows = rows + self.self_attn.within(self.norm1(rows), height, width)
        x = rows.transpose(1, 2).unflatten(2, (height, width))
        rows = (self.conv2(x) + x).flatten(2).transpose(1, 2)
        rows = rows + self.ffn(self.norm2(rows))
        return rows.transpose(1, 2).unflatten(2, (height, width))  # type: ignore[no-any-return]


def _block(stage: Stage, window: int) -> nn.Module:
    tower = stage.tower
    windows = _Windows(tower.hidden_size, tower.num_attention_heads, window)
    channels = _Channels(tower.hidden_size, stage.groups)
    halves = {"spatial_block": _Half(tower, windows), "channel_block": _Half(tower, channels)}
    return nn.Sequential(OrderedDict(halves))


class Davit(nn.Module):
    """Pixels, normalised, ``[N, 3, H, W]`` to patches ``[N, C, *grid]``."""

    def __init__(self, config: FlorenceConfig) -> None:
        super().__init__()
        before = [3, *(stage.tower.hidden_size for stage in config.stages)]
        self.convs = nn.ModuleList(map(_Patches, config.stages, before))
        self.blocks = nn.ModuleList(
            nn.Sequential(*(_block(stage, config.window) for _ in range(stage.tower.num_hidden_layers)))
            for stage in config.stages
        )

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        for conv, blocks in zip(self.convs, self.blocks, strict=True):
            pixels = blocks(conv(pixels))
        return pixels


class _Projector(nn.Module):
    """Patches to tokens of the language model, their mean first."""

    moments: Tensor

    def __init__(self, config: FlorenceConfig) -> None:
        super().__init__()
        before, width = config.stages[-1].tower.hidden_size, config.text.hidden_size
        self.row_embeddings = nn.Embedding(config.positions, before // 2)
        self.column_embeddings = nn.Embedding(config.positions, before - before // 2)
        self.register_buffer("moments", torch.zeros(config.moments, before))
        self.image_projection = nn.Linear(before, width, bias=False)
        self.image_proj_norm = nn.LayerNorm(width)

    def forward(self, patches: Tensor) -> Tensor:
        """``[N, C, *grid]`` -> ``[N, tokens, width of the language model]``."""
        height, width = patches.shape[2:]
        columns = self.column_embeddings.weight[None, :width].expand(height, -1, -1)
        rows = self.row_embeddings.weight[:height, None].expand(-1, width, -1)
        places = torch.cat([columns, rows], -1).flatten(0, 1) + self.moments[0]
        own = patches.flatten(2).transpose(1, 2) + places
        tokens = torch.cat([own.mean(1, keepdim=True), own], 1)
        return self.image_proj_norm(self.image_projection(tokens))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    """Attention and feed-forward, each normalised after it is added."""

    def __init__(self, config: BartConfig) -> None:
        super().__init__()
        self.self_attn = Attention(config.hidden_size, config.num_attention_heads)
        self.mlp = FeedForward(config)
        self.self_attn_layer_norm = nn.LayerNorm(config.hidden_size)
        self.final_layer_norm = nn.LayerNorm(config.hidden_size)

    def forward(self, x: Tensor) -> Tensor:
        x = self.self_attn_layer_norm(x + self.self_attn(x, x, None))
        return self.final_layer_norm(x + self.mlp(x))  # type: ignore[no-any-return]


class _Language(nn.Module):
    """BART's encoder; the first two of its positions are of no token."""

    def __init__(self, config: BartConfig) -> None:
        super().__init__()
        self.shared = nn.Embedding(config.vocab_size, config.hidden_size)
        self.embed_positions = nn.Embedding(config.max_position_embeddings + 2, config.hidden_size)
        self.layers = nn.Sequential(*(_Layer(config) for _ in range(config.num_hidden_layers)))
        self.layernorm_embedding = nn.LayerNorm(config.hidden_size)
        self.scale = config.hidden_size**0.5 if config.scaled else None

    def forward(self, image: Tensor, tokens: Tensor) -> Tensor:
        """An image's tokens ``[B, N, width]`` and those of a text, int64 ``[B, L]`` -> ``[B, N + L, width]``."""
        words = self.shared(tokens)
        x = torch.cat([image, words if self.scale is None else words * self.scale], 1)
        placed = x + self.embed_positions.weight[2 : x.shape[1] + 2]
        return self.layers(self.layernorm_embedding(placed))  # type: ignore[no-any-return]


class Florence(nn.Module):
    """Images and instruction to features; nothing of it is hidden from another part."""

    def __init__(self, config: FlorenceConfig) -> None:
        super().__init__()
        self.vision_tower, self.multi_modal_projector = Davit(config), _Projector(config)
        self.language_model = _Language(config.text)
        plain = (0.0,) * 3, (1.0,) * 3
        self.colours = nn.ModuleList(Colours() if own else Colours(*plain) for own in config.colours)

    def forward(self, images: list[Tensor], tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Features of the first image and the words ``[B, N + L, width]``; tokens of other images ``[B, V, N, width]``.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
        """
        pixels = [own(image) for own, image in zip(self.colours, images, strict=True)]
        seen = self.multi_modal_projector(self.vision_tower(torch.stack(pixels, 1).flatten(0, 1)))
        seen = seen.unflatten(0, (-1, len(images)))
        return self.language_model(seen[:, 0], tokens), seen[:, 1:]
