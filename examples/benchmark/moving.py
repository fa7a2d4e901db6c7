"""A fixed camera in front of which an arm moves, for ``tokens.py`` and ``large.py``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ttscompile.core.plan import TokenReuse

Array = npt.NDArray[np.float32]

REUSE = TokenReuse(threshold=0.02, refresh=10**6)
"""Tokens of patches that differ by more than 0.02 are computed; no frame is refreshed for its age."""


def picture(size: int, rng: np.random.Generator) -> Array:
    """Eight by eight squares of random colours ``[3, size, size]``, in 0..1."""
    return rng.random((3, 8, 8)).repeat(size // 8, 1).repeat(size // 8, 2).astype(np.float32)


def backgrounds(obs: Mapping[str, np.ndarray], rng: np.random.Generator) -> dict[str, Array]:
    """A picture for each camera of an observation, whose values are ``[1, frames, 3, H, W]``."""
    sizes = {key: value.shape[-2:] for key, value in obs.items() if value.ndim == 5}
    return {key: picture(max(size), rng)[:, : size[0], : size[1]] for key, size in sizes.items()}


def arm(still: Array, angle: float) -> Array:
    """The picture with an arm of two links in front of it, a tenth of it wide."""
    height, width = still.shape[-2:]
    y, x = np.mgrid[:height, :width] / np.array([[[height]], [[width]]])
    image, foot, turn = still.copy(), np.array([0.95, 0.5]), -np.pi / 2 + angle
    for length in (0.4, 0.35):
        way = length * np.array([np.sin(turn), np.cos(turn)])
        along = np.clip(((y - foot[0]) * way[0] + (x - foot[1]) * way[1]) / length**2, 0, 1)
        near = (y - foot[0] - along * way[0]) ** 2 + (x - foot[1] - along * way[1]) ** 2 < 0.05**2
        image[:, near] = 0.9
        foot, turn = foot + way, turn + 1.5 * angle
    return image
