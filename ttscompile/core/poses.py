"""Poses relative to a measured one, as nine numbers: a position, and the first two rows of the matrix of a rotation.

    R(p, q)                  rows a = p / |p|, b = (q - (a q) a) / |q - (a q) a| and a x b
    composed with (m, M)     position M x + m, rows of M R
    its inverse              position M^T (x - m), rows of M^T R

Source: ``xyz+rot6d`` of GR00T N1.7, lerobot.policies.groot.utils of huggingface/lerobot 0.6.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import SpecError
from .coercion import Array, integer

NUMBERS = 9
LEAST = 1e-3
"""Two vectors whose first, or what of the second is not along it, is shorter than this are no rotation."""


@dataclass(frozen=True)
class Pose:
    """A pose in the actions that is relative to a measured one.

    Attributes:
        action: which number of the actions is its first.
        measured: which number of the observation is the measured one's first.
    """

    action: int
    measured: int

    def __post_init__(self) -> None:
        for name in ("action", "measured"):
            object.__setattr__(self, name, integer(getattr(self, name), f"a pose's {name}", SpecError))

    @property
    def numbers(self) -> slice:
        """Of the actions."""
        return slice(self.action, self.action + NUMBERS)


def composed(measured: Any, pose: Any, library: Any = np, inverse: bool = False) -> Any:
    """Poses ``[..., 9]`` seen from where a measured one is seen from; or the inverse. Of numpy or torch, as given."""
    rotation, own, position = _matrix(measured, library), _matrix(pose, library), pose[..., :3]
    if inverse:
        rotation, position = rotation.swapaxes(-1, -2), position - measured[..., :3]
    position, rows = (rotation @ position[..., None])[..., 0], (rotation @ own)[..., :2, :]
    position = position if inverse else position + measured[..., :3]
    return library.concatenate((position, rows.reshape((*rows.shape[:-2], 6))), -1)


def orthonormal(poses: Array) -> Array:
    """The same poses ``[..., 9]``, the rotation of each by two rows of length 1 at right angles."""
    return np.concatenate((poses[..., :3], _matrix(poses, np)[..., :2, :].reshape(*poses.shape[:-1], 6)), -1)


def has_rotation(poses: Array) -> Array:
    """Of which poses ``[..., 9]`` the six last numbers are a rotation: see ``LEAST``."""
    first, second = poses[..., 3:6].astype(np.float64), poses[..., 6:].astype(np.float64)
    square, along, other = (first * first).sum(-1), (first * second).sum(-1), (second * second).sum(-1)
    return np.asarray((square >= LEAST**2) & (square * other - along**2 >= LEAST**2 * square))


def _matrix(poses: Any, library: Any) -> Any:
    first, second = poses[..., 3:6], poses[..., 6:]
    first = first / (first * first).sum(-1)[..., None] ** 0.5
    second = second - (first * second).sum(-1)[..., None] * first
    second = second / (second * second).sum(-1)[..., None] ** 0.5
    third = first[..., [1, 2, 0]] * second[..., [2, 0, 1]] - first[..., [2, 0, 1]] * second[..., [1, 2, 0]]
    return library.stack((first, second, third), -2)
