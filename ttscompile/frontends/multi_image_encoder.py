"""Diffusion Policy's encoder of several cameras, rebuilt: resize, centre crop, a ResNet and the mean over its map.

Source: ``MultiImageObsEncoder`` of real-stanford/diffusion_policy (Chi et al., arXiv 2303.04137).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from .image_geometry import ResizeCrop
from .resnet import CHANNELS, Norm, resnet

COLOURS = 3
"""Channels of an image, which torchvision's ResNets have."""


@dataclass(frozen=True)
class View:
    """How the images of one observation key are taken in.

    Attributes:
        resize: ``(height, width)`` that it is brought to; None for none.
        crop: of the centre that is looked at; None for the whole image.
        scale: of each colour, after that.
    """

    height: int
    width: int
    resize: tuple[int, int] | None
    crop: tuple[int, int] | None
    scale: tuple[float, ...]
    offset: tuple[float, ...]


class _Camera(nn.Module):
    scale: torch.Tensor
    offset: torch.Tensor

    def __init__(self, view: View) -> None:
        super().__init__()
        # As torchvision 0.13 resizes tensors, which the original's environment has.
        self.geometry = ResizeCrop(view.height, view.width, view.resize, view.crop, antialias=False)
        for name, values in (("scale", view.scale), ("offset", view.offset)):
            self.register_buffer(name, torch.tensor(values).reshape(-1, 1, 1), persistent=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, 3, H, W]`` -> ``[N, 3, H', W']``."""
        return self.geometry(images) * self.scale + self.offset  # type: ignore[no-any-return]


class MultiImageEncoder(nn.Module):
    """All keys of the observation to one vector for each observed step: the images' features, then the others."""

    def __init__(
        self, views: Mapping[str, View], low_dim: Mapping[str, int], network: str, norm: Norm, shared: bool
    ) -> None:
        super().__init__()
        self.views, self.low_dim = tuple(views), tuple(low_dim)
        self.width = CHANNELS * len(views) + sum(low_dim.values())
        # Lists, because a key may be any text and the name of a submodule may not.
        self.cameras = nn.ModuleList(_Camera(view) for view in views.values())
        count = min(len(views), 1) if shared else len(views)
        self.networks = nn.ModuleList(resnet(COLOURS, norm, network) for _ in range(count))

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, low-dimensional ones normalised -> ``[B, To, width]``."""
        features = []
        for i, (key, camera) in enumerate(zip(self.views, self.cameras, strict=True)):
            images = observations[key]
            maps = self.networks[min(i, len(self.networks) - 1)](camera(images.flatten(0, 1)))
            features.append(maps.mean((2, 3)).reshape(images.shape[0], images.shape[1], CHANNELS))
        return torch.cat((*features, *(observations[key] for key in self.low_dim)), dim=-1)
