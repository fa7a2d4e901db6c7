"""robomimic's observation encoder, rebuilt: centre crop, ResNet-18, spatial softmax, linear layer; one a camera.

Written from the description of the networks, with attribute names under which the weights of an original checkpoint
load. torchvision and robomimic are not needed.

Source: robomimic 0.2 (Mandlekar et al., arXiv 2108.03298) as Diffusion Policy configures it; spatial softmax of Finn
et al. (arXiv 1509.06113).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from .image_geometry import ResizeCrop
from .resnet import CHANNELS, SHRINKS, Norm, group_norm, resnet

KEYPOINTS = 32
FEATURES = 64
"""Width of a camera's features; both as in robomimic's image experiments, which Diffusion Policy takes over."""


class SpatialSoftmax(nn.Module):
    """Expected position, in -1..1, of each learned keypoint under a softmax over a map of ``height x width``."""

    temperature: torch.Tensor
    pos_x: torch.Tensor
    pos_y: torch.Tensor

    def __init__(self, height: int, width: int, keypoints: int = KEYPOINTS) -> None:
        super().__init__()
        self.nets = nn.Conv2d(CHANNELS, keypoints, 1)
        x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
        self.register_buffer("temperature", torch.ones(1))
        self.register_buffer("pos_x", torch.from_numpy(x.reshape(1, -1)).float())
        self.register_buffer("pos_y", torch.from_numpy(y.reshape(1, -1)).float())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """``[N, 512, height, width]`` -> ``[N, 2 keypoints]``: x and y of keypoint 0, of keypoint 1, and so on."""
        attention = (self.nets(features).flatten(2) / self.temperature).softmax(-1)
        positions = torch.cat((self.pos_x, self.pos_y)).T
        return torch.flatten(attention @ positions, 1)


@dataclass(frozen=True)
class Camera:
    """How the images of one observation key are taken in.

    Attributes:
        shape: ``(C, H, W)`` as they come.
        crop: ``(height, width)`` of the centre that is looked at; None for the whole image.
        scale: of the image's normaliser, one number for all of it.
    """

    shape: tuple[int, int, int]
    crop: tuple[int, int] | None
    scale: float = 1.0
    offset: float = 0.0


class CameraEncoder(nn.Module):
    """Images of one camera to features: normalise, crop the centre, ResNet-18, spatial softmax, linear, ReLU."""

    def __init__(self, camera: Camera, norm: Norm) -> None:
        super().__init__()
        self.camera = camera
        channels, height, width = camera.shape
        self.crop = ResizeCrop(height, width, crop=camera.crop)
        height, width = self.crop.size
        numbered = nn.Sequential(*resnet(channels, norm))
        self.backbone = nn.Sequential(OrderedDict(nets=numbered))  # as the checkpoint names them
        self.pool = SpatialSoftmax(math.ceil(height / SHRINKS), math.ceil(width / SHRINKS))
        self.linear = nn.Linear(2 * KEYPOINTS, FEATURES)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, C, H, W]`` -> ``[N, 64]``."""
        x = self.crop(images)
        if (self.camera.scale, self.camera.offset) != (1.0, 0.0):
            x = x * self.camera.scale + self.camera.offset
        return torch.relu(self.linear(self.pool(self.backbone(x))))


class ObservationEncoder(nn.Module):
    """All keys of the observation to one vector for each observed step."""

    def __init__(self, inputs: Mapping[str, Camera | int], group_norm_in_place_of_batch_norm: bool) -> None:
        super().__init__()
        cameras = {key: each for key, each in inputs.items() if isinstance(each, Camera)}
        self.order = tuple(inputs)
        self.width = sum(FEATURES if isinstance(each, Camera) else each for each in inputs.values())
        norm = group_norm if group_norm_in_place_of_batch_norm else nn.BatchNorm2d
        # A list, because a key may be any text and the name of a submodule may not.
        self.cameras = nn.ModuleList(CameraEncoder(each, norm) for each in cameras.values())
        self.position = {key: i for i, key in enumerate(cameras)}

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, low-dimensional ones normalised -> ``[B, To, width]``."""
        features = []
        for key in self.order:
            x = observations[key]
            if key in self.position:
                x = self.cameras[self.position[key]](x.flatten(0, 1)).reshape(x.shape[0], x.shape[1], FEATURES)
            features.append(x.flatten(2))
        return torch.cat(features, dim=-1)
