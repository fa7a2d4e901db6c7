"""Tiny EO-1 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_eo1.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

from pathlib import Path

import numpy as np
import torch

from . import groots
from .vlas import CAMERAS, Array, drawn_frame, see, unpack

KINDS = ("plain", "deep")
"""Of the second's vision transformer the attention windows are smaller, and an activation stands between the layers
that give its actions; its cameras have two sizes."""
TASKS = ("Push the block!", "lift it")
SAVED = Path(__file__).parent / "golden" / "lerobot_eo1"
BACKBONE = "Qwen2.5-VL-tiny"
STATE_DIM, ACTION_DIM, HORIZON = 4, 5, 6
STATE_PADDED, PADDED = 7, 9
SIZES = {"plain": (((24, 32), (30, 27)), ((30, 21), (64, 40))), "deep": (((33, 48), (20, 36)), ((41, 24), (16, 50)))}
"""Height and width of each camera's images, in each call."""


def save(kind: str, folder: Path, call: int = 0) -> Path:
    """A policy, for images of this call, and, beside it, the files of its backbone. Returns its directory."""
    directory = unpack(SAVED / kind, folder, groots.weights)
    see(directory, dict(zip(CAMERAS, SIZES[kind][call], strict=True)))
    return directory


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    return groots.weights(shapes)


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame; of the second call's images the sizes are others, and so is the state."""
    return drawn_frame(call + 3, STATE_DIM, dict(zip(CAMERAS, SIZES[kind][call], strict=True)))


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, PADDED)).astype(np.float32)
