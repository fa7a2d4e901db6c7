"""The observation encoder of 3D Diffusion Policy, rebuilt: a small PointNet, and an MLP for the robot's state.

Written from the description of the networks, with attribute names under which the weights of an original checkpoint
load.

Source: Ze et al., 3D Diffusion Policy (arXiv 2403.03954); PointNet of Qi et al. (arXiv 1612.00593).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

POINTS, STATE, ROBOT = "point_cloud", "agent_pos", "imagin_robot"
"""Keys of the observation: the points seen, the robot's state, and points of the robot that are added to those seen."""
PLACE, COLOURED = 3, 6
"""Channels of a point: where it is, and its colour."""

_STATE_WIDTH = 64
_WIDTHS = (64, 128, 256)
_COLOURED_WIDTHS = (*_WIDTHS, 512)


class PointNet(nn.Module):
    """Points to a vector: an MLP of each point, the largest of each feature over all points, and a linear layer.

    Args:
        coloured: whether points have a colour; the MLP is a layer deeper then, which has no norm.
        features: of the vector; None for those of the MLP, without a layer after it.
        norms: whether the MLP has layer norms.
    """

    def __init__(self, coloured: bool, features: int | None, norms: bool, last_norm: bool) -> None:
        super().__init__()
        widths = _COLOURED_WIDTHS if coloured else _WIDTHS
        layers: list[nn.Module] = []
        before = COLOURED if coloured else PLACE
        for width in widths:
            layers += [nn.Linear(before, width), nn.LayerNorm(width) if norms else nn.Identity(), nn.ReLU()]
            before = width
        self.mlp = nn.Sequential(*(layers[:-2] if coloured else layers))
        self.final_projection: nn.Module = nn.Identity()
        self.width = features or before
        if features is not None:
            linear = nn.Linear(before, features)
            self.final_projection = nn.Sequential(linear, nn.LayerNorm(features)) if last_norm else linear

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """``[N, points, channels]`` -> ``[N, width]``."""
        return self.final_projection(self.mlp(points).amax(1))  # type: ignore[no-any-return]


class PointCloudEncoder(nn.Module):
    """Points and the robot's state to one vector for each observed step."""

    def __init__(self, extractor: PointNet, channels: int, state: int) -> None:
        super().__init__()
        self.extractor, self.channels = extractor, channels
        self.state_mlp = nn.Sequential(nn.Linear(state, _STATE_WIDTH), nn.ReLU(), nn.Linear(_STATE_WIDTH, _STATE_WIDTH))
        self.width = extractor.width + _STATE_WIDTH

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, normalised -> ``[B, To, width]``."""
        clouds = [observations[key][..., : self.channels] for key in (POINTS, ROBOT) if key in observations]
        points = torch.cat(clouds, dim=2)
        features = self.extractor(points.flatten(0, 1)).reshape(*points.shape[:2], self.extractor.width)
        return torch.cat((features, self.state_mlp(observations[STATE])), dim=-1)
