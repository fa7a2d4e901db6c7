"""Tiny GR00T N1.7 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_groot.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from .hybrid import fill
from .vlas import CAMERAS, STATE, Array

KINDS = ("words", "native")
"""The second has statistics and groups of its base, two frames a camera, and differs in rarer entries."""
TASKS = ("Push the block!", "lift it")
SIZES = ((24, 24), (40, 30))
"""Height and width of the images of each call."""
SAVED = Path(__file__).parent / "golden" / "lerobot_groot"
BASE, BACKBONE, SHAPES = "gr00t-tiny", "Cosmos-Reason2-2B", "shapes.json"
STATE_DIM, ACTION_DIM, STATE_PADDED, PADDED, HORIZON = 4, 5, 6, 7, 6


def save(kind: str, folder: Path, saved: Path = SAVED) -> Path:
    """A policy and, beside it, the files of its base and backbone. Returns the policy's directory."""
    shutil.copytree(saved / kind, folder, dirs_exist_ok=True)
    shapes = json.loads((folder / "policy" / SHAPES).read_text())
    (folder / "policy" / SHAPES).unlink()
    save_file(weights(shapes), folder / "policy" / "model.safetensors")
    return folder / "policy"


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    drawn = fill({name: torch.empty(shape) for name, shape in shapes.items()}, 5)
    # Weights of each embodiment are [kinds, before, after]; ``fill`` takes all but the first for inputs.
    return {name: 1.5 * value if name.endswith(".W") else value for name, value in drawn.items()}


def observation(call: int) -> dict[str, Array]:
    """One frame; of the second call's images the size is another, and so is the state."""
    rng = np.random.RandomState(call + 3)
    found: dict[str, Array] = {STATE: rng.standard_normal(STATE_DIM).astype(np.float32)}
    return found | {key: rng.uniform(0, 1, (3, *SIZES[call])).astype(np.float32) for key in CAMERAS}


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, PADDED)).astype(np.float32)
