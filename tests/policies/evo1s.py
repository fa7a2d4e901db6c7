"""Tiny evo1 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_evo1.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from .hybrid import fill
from .vlas import CAMERAS, STATE, Array

KINDS = ("words", "pooled")
"""The second reads the last word alone, has three embodiments and one action a chunk, and differs in rarer entries."""
TASKS = ("push the block", " Lift it.\n")
SIZES = ((28, 28), (40, 24))
"""Height and width of the images of each call; the first is what the encoder sees."""
SAVED = Path(__file__).parent / "golden" / "lerobot_evo1"
LANGUAGE, SHAPES = "internvl-tiny", "shapes.json"
STATE_DIM, PADDED, HORIZON = 4, 6, {"words": 6, "pooled": 1}


def save(kind: str, folder: Path) -> Path:
    """A policy and, beside it, the files of its language model. Returns the policy's directory."""
    for name in ("policy", LANGUAGE):
        shutil.copytree(SAVED / kind / name, folder / name)
    shapes = json.loads((folder / "policy" / SHAPES).read_text())
    (folder / "policy" / SHAPES).unlink()
    save_file(weights(shapes), folder / "policy" / "model.safetensors")
    return folder / "policy"


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    drawn = fill({name: torch.empty(shape) for name, shape in shapes.items()}, 5)
    return {name: _waves(*value.shape[1:]) if name.endswith(".pe") else value for name, value in drawn.items()}


def _waves(count: int, width: int) -> torch.Tensor:
    """Sines and cosines of positions, ``[1, count, width]``, as lerobot computes and saves them."""
    rates = torch.exp(torch.arange(0, width, 2) * -(math.log(10000.0) / width))
    angles = torch.arange(count).unsqueeze(1) * rates
    return torch.stack([angles.sin(), angles.cos()], -1).reshape(1, count, width)


def observation(call: int) -> dict[str, Array]:
    """One frame; of the second call's images the size is another, and so is the state."""
    rng = np.random.RandomState(call)
    found: dict[str, Array] = {STATE: rng.standard_normal(STATE_DIM).astype(np.float32)}
    return found | {key: rng.uniform(0, 1, (3, *SIZES[call])).astype(np.float32) for key in CAMERAS}


def noise(kind: str) -> Array:
    """``[1, T, D]``, in -1..1; lerobot draws the same numbers in 0..1."""
    drawn = np.random.RandomState(7).uniform(0, 1, (1, HORIZON[kind], PADDED)).astype(np.float32)
    return drawn * 2 - 1
