"""Tiny EO-1 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_eo1.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from . import groots
from .lerobot_tiny import change_json
from .vlas import CAMERAS, STATE, Array

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
    shutil.copytree(SAVED / kind, folder, dirs_exist_ok=True)
    directory = folder / "policy"
    shapes = json.loads((directory / groots.SHAPES).read_text())
    (directory / groots.SHAPES).unlink()
    save_file(groots.weights(shapes), directory / "model.safetensors")
    features = json.loads((directory / "config.json").read_text())["input_features"]
    for key, size in zip(CAMERAS, SIZES[kind][call], strict=True):
        features[key]["shape"] = [3, *size]
    change_json(directory / "config.json", input_features=features)
    return directory


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    return groots.weights(shapes)


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame; of the second call's images the sizes are others, and so is the state."""
    rng = np.random.RandomState(call + 3)
    found: dict[str, Array] = {STATE: rng.standard_normal(STATE_DIM).astype(np.float32)}
    pairs = zip(CAMERAS, SIZES[kind][call], strict=True)
    return found | {key: rng.uniform(0, 1, (3, *size)).astype(np.float32) for key, size in pairs}


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, PADDED)).astype(np.float32)
