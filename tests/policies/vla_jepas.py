"""Tiny VLA-JEPA policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_vla_jepa.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

from pathlib import Path

import numpy as np
import torch

from . import groots
from .vlas import CAMERAS, STATE, Array, drawn_frame, see, unpack

KINDS = ("libero", "plain")
"""The first has a world model and LIBERO's rule of the gripper, and resizes its images; the second has half of that
rule, no state, and cameras of two sizes."""
TASKS = ("Push the block!", "lift it")
SAVED = Path(__file__).parent / "golden" / "lerobot_vla_jepa"
BACKBONE = "Qwen3-VL-tiny"
STATE_DIM, ACTION_DIM, HORIZON = 4, 7, 5
SIZES = {"libero": (((24, 32), (24, 32)), ((30, 21), (64, 40))), "plain": (((24, 32), (20, 36)), ((40, 24), (16, 16)))}
"""Height and width of each camera's images, in each call."""


def save(kind: str, folder: Path, call: int = 0) -> Path:
    """A policy, for images of this call, and, beside it, the files of its backbone. Returns its directory."""
    directory = unpack(SAVED / kind, folder, weights)
    if kind == "plain":
        see(directory, dict(zip(CAMERAS, SIZES[kind][call], strict=True)))
    return directory


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves; such that few actions are clipped."""
    drawn = groots.weights(shapes)
    drawn["model.action_model.action_decoder.layer2.weight"] *= 0.3
    return drawn


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame; of the second call's images the sizes are others, and so is the state."""
    found = drawn_frame(call + 3, STATE_DIM, dict(zip(CAMERAS, SIZES[kind][call], strict=True)))
    return {key: value for key, value in found.items() if key != STATE or kind == "libero"}


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, ACTION_DIM)).astype(np.float32)
