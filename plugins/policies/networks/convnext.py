"""ConvNeXt, without its pooling and classifier: a picture to a map of features.

Parameters are called as in the network of timm, of which stem and stages were taken as a list.

Source: Liu et al., A ConvNet for the 2020s (arXiv 2201.03545); ``ConvNeXt`` of timm 0.9.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from .layers import TimmMlp

_EPSILON = 1e-6


class _Norm(nn.LayerNorm):
    """Of the channels, ``[N, C, H, W]``."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=_EPSILON)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        normed = functional.layer_norm(x.movedim(1, -1), self.normalized_shape, self.weight, self.bias, self.eps)
        return normed.movedim(-1, 1)


class _Block(nn.Module):
    """A convolution of each channel by itself, a norm and two layers, added channel by channel as ``gamma`` says."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_dw = nn.Conv2d(channels, channels, 7, padding=3, groups=channels)
        self.norm = nn.LayerNorm(channels, eps=_EPSILON)
        self.mlp = TimmMlp(channels, exact=True)
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        added: torch.Tensor = self.mlp(self.norm(self.conv_dw(x).movedim(1, -1))).movedim(-1, 1)
        return x + added * self.gamma[:, None, None]


class _Stage(nn.Module):
    """Blocks, behind a convolution that halves the map where channels change."""

    def __init__(self, before: int, channels: int, depth: int) -> None:
        super().__init__()
        halve = nn.Sequential(_Norm(before), nn.Conv2d(before, channels, 2, 2))
        self.downsample = halve if before != channels else nn.Identity()
        self.blocks = nn.Sequential(*(_Block(channels) for _ in range(depth)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.blocks(self.downsample(x))  # type: ignore[no-any-return]


def convnext(channels: Sequence[int], depths: Sequence[int]) -> nn.Sequential:
    """A network of stages of so many channels and blocks: ``[N, 3, H, W]`` -> ``[N, C, H / 32, W / 32]``, rounded down.

    The first stage is behind patches of 4 x 4 pixels, and each of the others halves the map.
    """
    sizes = zip(pairwise((channels[0], *channels)), depths, strict=True)
    stem = nn.Sequential(nn.Conv2d(3, channels[0], 4, 4), _Norm(channels[0]))
    return nn.Sequential(stem, nn.Sequential(*(_Stage(*widths, depth) for widths, depth in sizes)))
