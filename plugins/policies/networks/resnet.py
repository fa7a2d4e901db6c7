"""ResNet, rebuilt: the residual network with which robot policies read images, without its pooling and classifier.

Written from the description of the network, with the attribute names of torchvision's, which is not needed.

Source: He et al. (arXiv 1512.03385); group norm in the place of batch norm as in Diffusion Policy (arXiv 2303.04137).
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping

import torch
from torch import nn

DEPTHS: Mapping[str, tuple[int, ...]] = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
"""Blocks of the four stages, by the name of the network. Deeper ones have blocks of another kind."""
DEEPER: Mapping[str, tuple[int, ...]] = {"resnet50": (3, 4, 6, 3)}
"""The same of networks of ``Bottleneck``, which have four times the channels."""
CHANNELS = 512
"""Of the features."""
WIDER = 4
"""Channels of a ``Bottleneck`` that come out, for one within."""
SHRINKS = 32
"""Pixels of the image for one of the features, along each axis."""

_STAGES = ((64, 1), (128, 2), (256, 2), (512, 2))  # channels and stride of the four stages

Norm = Callable[[int], nn.Module]


def group_norm(channels: int) -> nn.Module:
    """What policies put in the place of batch norm: groups of 16 channels."""
    return nn.GroupNorm(channels // 16, channels)


class ResidualBlock(nn.Module):
    """``relu(x + norm(conv(relu(norm(conv(x))))))``; the shortcut is a strided 1 x 1 convolution where sizes change."""

    def __init__(self, channels_in: int, channels: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride, padding=1, bias=False)
        self.bn1 = norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = norm(channels)
        self.downsample = None
        if stride != 1 or channels_in != channels:
            self.downsample = nn.Sequential(nn.Conv2d(channels_in, channels, 1, stride, bias=False), norm(channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[N, channels_in, H, W]`` -> ``[N, channels, H / stride, W / stride]``, rounded up."""
        shortcut = x if self.downsample is None else self.downsample(x)
        inner = self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))
        return torch.relu(inner + shortcut)


class Bottleneck(nn.Module):
    """The same of three convolutions, of which the middle one has a quarter of the channels that come out."""

    def __init__(self, channels_in: int, channels: int, stride: int, norm: Norm) -> None:
        super().__init__()
        out = channels * WIDER
        self.conv1 = nn.Conv2d(channels_in, channels, 1, bias=False)
        self.bn1 = norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, stride, padding=1, bias=False)
        self.bn2 = norm(channels)
        self.conv3 = nn.Conv2d(channels, out, 1, bias=False)
        self.bn3 = norm(out)
        self.downsample = None
        if stride != 1 or channels_in != out:
            self.downsample = nn.Sequential(nn.Conv2d(channels_in, out, 1, stride, bias=False), norm(out))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[N, channels_in, H, W]`` -> ``[N, 4 channels, H / stride, W / stride]``, rounded up."""
        shortcut = x if self.downsample is None else self.downsample(x)
        inner = torch.relu(self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x))))))
        return torch.relu(self.bn3(self.conv3(inner)) + shortcut)


def resnet(channels: int, norm: Norm, name: str = "resnet18") -> nn.Sequential:
    """A ResNet without its pooling and classifier: ``[N, C, H, W]`` -> ``[N, 512, H / 32, W / 32]``, rounded up.

    A deeper one gives 2048 channels.

    Its layers have torchvision's names (``conv1``, ``layer1``); ``nn.Sequential(*resnet(...))`` numbers them, as the
    checkpoints of code that took ``list(children())`` of torchvision's network do.
    """
    layers: OrderedDict[str, nn.Module] = OrderedDict(
        conv1=nn.Conv2d(channels, 64, 7, stride=2, padding=3, bias=False),
        bn1=norm(64),
        relu=nn.ReLU(),
        maxpool=nn.MaxPool2d(3, stride=2, padding=1),
    )
    block, wider = (Bottleneck, WIDER) if name in DEEPER else (ResidualBlock, 1)
    width, depths = 64, {**DEPTHS, **DEEPER}[name]
    for stage, ((channels_out, stride), depth) in enumerate(zip(_STAGES, depths, strict=True), start=1):
        first, width = block(width, channels_out, stride, norm), channels_out * wider
        others = (block(width, channels_out, 1, norm) for _ in range(depth - 1))
        layers[f"layer{stage}"] = nn.Sequential(first, *others)
    return nn.Sequential(layers)
