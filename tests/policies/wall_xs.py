"""Tiny wall_x policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_wall_x.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

from pathlib import Path

import numpy as np
import torch

from . import groots
from .vlas import STATE, Array, see, unpack

KINDS = ("flow", "nested")
"""The first is as wall-oss-flow but for its size; the second has the configuration that transformers writes now, images
that are resized three times, an expert that reads half of a token, three cameras, and differs in rarer entries."""
TASKS = ("Push the block!", "lift it.")
SAVED = Path(__file__).parent / "golden" / "lerobot_wall_x"
BASE = "wall-oss-tiny"
CAMERAS = {
    "flow": ("observation.images.front", "observation.images.wrist"),
    "nested": ("observation.images.face_view", "observation.images.left_hand_view", "observation.images.wrist"),
}
"""Of the second kind the first has a name of lerobot's own in the prompt."""
MISSING = {"flow": 0, "nested": 1}
"""Which camera the robot lacks."""
SIZES = {
    "flow": (((24, 32), (24, 32)), ((45, 31), (64, 300))),
    "nested": (((24, 32), (24, 32), (36, 36)), ((40, 24), (40, 24), (30, 52))),
}
"""Height and width of each camera's images, in each call."""
STATE_DIM = {"flow": 4, "nested": 3}
ACTION_DIM, MOST_ACTIONS = {"flow": 5, "nested": 4}, {"flow": 7, "nested": 4}
HORIZON = {"flow": 6, "nested": 5}


def save(kind: str, folder: Path, call: int = 0) -> Path:
    """A policy, for images of this call, and, beside it, the files of its base. Returns its directory."""
    directory = unpack(SAVED / kind, folder, weights)
    see(directory, dict(zip(CAMERAS[kind], SIZES[kind][call], strict=True)))
    return directory


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves; attention is sharp, so that the state, one token of many, is seen."""
    return {name: value * (1.5 if "q_proj" in name else 1) for name, value in groots.weights(shapes).items()}


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame, of bytes as cameras have them; in the second call sizes of images and the state are others."""
    rng = np.random.RandomState(call + 3)
    found: dict[str, Array] = {STATE: rng.standard_normal(STATE_DIM[kind]).astype(np.float32)}
    pairs = zip(CAMERAS[kind], SIZES[kind][call], strict=True)
    return found | {key: rng.randint(0, 256, (3, *size)).astype(np.float32) / 255 for key, size in pairs}


def noise(kind: str) -> Array:
    """``[1, T, D]``."""
    drawn = np.random.RandomState(7).standard_normal((1, HORIZON[kind], MOST_ACTIONS[kind]))
    return drawn.astype(np.float32)
