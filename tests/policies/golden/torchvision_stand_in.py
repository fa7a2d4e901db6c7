"""What the originals take of torchvision 0.13, for which there is no build for the CPU, in its place in sys.modules.

The ResNet is ours, which ``test_resnet.py`` holds against another implementation.
"""

import sys
from types import ModuleType
from typing import Any

import torch
from torch import nn

from ttscompile.policies.networks.resnet import resnet


class Resnet(nn.Module):
    """With torchvision's names, in its order."""

    def __init__(self, name: str) -> None:
        super().__init__()
        for key, layer in resnet(3, nn.BatchNorm2d, name).named_children():
            self.add_module(key, layer)
        self.avgpool, self.fc = nn.AdaptiveAvgPool2d(1), nn.Linear(512, 1000)

    def forward(self, x: torch.Tensor) -> Any:
        """``[N, 3, H, W]`` -> what the last layer gives."""
        for layer in list(self.children())[:-1]:
            x = layer(x)
        return self.fc(x.flatten(1))


class Resize(nn.Module):
    """Of tensors, without antialiasing."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[N, C, *size]``."""
        return nn.functional.interpolate(x, self.size, mode="bilinear", align_corners=False)


class Normalize(nn.Module):
    """Mean and deviation of each channel."""

    def __init__(self, mean: list[float], std: list[float]) -> None:
        super().__init__()
        self.mean, self.std = (torch.tensor(each).reshape(-1, 1, 1) for each in (mean, std))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Of mean 0 and deviation 1."""
        return (x - self.mean) / self.std


def center_crop(img: torch.Tensor, output_size: tuple[int, int]) -> torch.Tensor:
    """The middle; Python rounds halves to even."""
    (height, width), (h, w) = img.shape[-2:], output_size
    top, left = round((height - h) / 2.0), round((width - w) / 2.0)
    return img[..., top : top + h, left : left + w]


class CenterCrop(nn.Module):
    """``center_crop`` as a module."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """The middle."""
        return center_crop(x, self.size)


def put_in_place() -> None:
    """Make ``import torchvision`` find these."""
    modules: dict[str, Any] = {
        name: ModuleType(name) for name in ("", ".models", ".transforms", ".transforms.functional")
    }
    modules[".transforms.functional"].center_crop = center_crop
    for each in (Resize, Normalize, CenterCrop):
        setattr(modules[".transforms"], each.__name__, each)
    modules[".transforms"].functional = modules[".transforms.functional"]
    modules[".transforms"].Lambda = None
    for name in ("resnet18", "resnet34"):
        setattr(modules[".models"], name, lambda name=name, **settings: Resnet(name))
    for name, module in modules.items():
        sys.modules[f"torchvision{name}"] = module
        if name.count(".") == 1:
            setattr(modules[""], name[1:], module)
