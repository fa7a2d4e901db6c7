"""What DiT-Policy's network denoises by: a token for each piece of each camera's image, and one of the robot's state.

Parameters are called as in the original, SudeepDasari/dit-policy, ``data4robotics/agent.py`` and ``models/resnet.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .image_geometry import ResizeCrop
from .resnet import CHANNELS, Norm, group_norm, resnet

CAMERA, STATE = "cam{}", "state"
PIXELS, SEEN = 256, 224
"""Of an image along each side: as it is recorded and given, and as the network sees it."""

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet


@dataclass(frozen=True)
class TokensConfig:
    """Sizes and variant.

    Attributes:
        network: ``resnet18`` or ``resnet34``.
        groups: of each group norm; None for groups of 16 channels.
        pooled: whether an image is one token, or one for each of the 7 x 7 pieces.
        state: numbers of the robot's state; 0 where it is not observed.
        padded: whether the state is put before the numbers of each token, in place of a token of its own.
        projected: width that the tokens are brought to by one layer; None for none.
        normed: whether the tokens are normalised.
    """

    cameras: int
    network: str = "resnet18"
    groups: int | None = None
    pooled: bool = False
    state: int = 0
    padded: bool = False
    projected: int | None = None
    normed: bool = False

    @property
    def joined(self) -> int:
        """Numbers of a token before it is projected."""
        return CHANNELS + (self.state if self.padded else 0)

    @property
    def width(self) -> int:
        """Numbers of a token."""
        return self.projected or self.joined


class _ResNet(nn.Module):
    """Images ``[B, 3, 224, 224]`` -> tokens ``[B, 49, 512]``, or ``[B, 1, 512]``."""

    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        groups = config.groups
        norm: Norm = group_norm if groups is None else lambda channels: nn.GroupNorm(groups, channels)
        self._model, self.pooled = resnet(3, norm, config.network), config.pooled

    def forward(self, x: Tensor) -> Tensor:
        x = self._model(x).flatten(2).transpose(1, 2)
        return x.mean(1, keepdim=True) if self.pooled else x


class Tokens(nn.Module):
    """``tokenize_obs``: images ``[B, 3, 224, 224]`` of each camera, and the state ``[B, .]`` -> ``[B, S, width]``."""

    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        self.config = config
        self.visual_features = nn.ModuleList(_ResNet(config) for _ in range(config.cameras))
        if config.state and not config.padded:
            self._obs_proc = nn.Sequential(nn.Identity(), nn.Linear(config.state, config.joined))  # after a dropout
        self.post_proc = nn.Sequential(
            nn.Identity() if config.projected in (None, config.joined) else nn.Linear(config.joined, config.width),
            nn.LayerNorm(config.width) if config.normed else nn.Identity(),
        )

    def forward(self, images: list[Tensor], state: Tensor | None) -> Tensor:
        """See the class."""
        tokens = torch.cat([see(each) for see, each in zip(self.visual_features, images, strict=True)], 1)
        if state is not None and self.config.padded:
            tokens = torch.cat([state[:, None].expand(-1, tokens.shape[1], -1), tokens], 2)
        elif state is not None:
            tokens = torch.cat([tokens, self._obs_proc(state)[:, None]], 1)
        return self.post_proc(tokens)  # type: ignore[no-any-return]


class Observed(nn.Module):
    """The tokens of what the robot gives: images of 0..1 as they were recorded, and its state in its own units."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, tokens: Tokens) -> None:
        super().__init__()
        self.tokens = tokens
        # As the version of torchvision that the original asks for resizes tensors.
        self.geometry = ResizeCrop(PIXELS, PIXELS, (SEEN, SEEN), antialias=False)
        for name, values in (("mean", _MEAN), ("deviation", _DEVIATION)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """By key -> ``[B, S, width]``."""
        given = [observations[CAMERA.format(i)] for i in range(self.tokens.config.cameras)]
        images = [(self.geometry(each) - self.mean) / self.deviation for each in given]
        return self.tokens(images, observations.get(STATE))  # type: ignore[no-any-return]
