"""Tiny evo1 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_evo1.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import math
from pathlib import Path

import numpy as np
import torch

from .hybrid import fill
from .vlas import CAMERAS, SHAPES as SHAPES, Array, drawn_frame, unpack

KINDS = ("words", "pooled")
"""The second reads the last word alone, has three embodiments and one action a chunk, and differs in rarer entries."""
TASKS = ("push the block", " Lift it.\n")
SIZES = ((28, 28), (40, 24))
"""Height and width of the images of each call; the first is what the encoder sees."""
SAVED = Path(__file__).parent / "golden" / "lerobot_evo1"
LANGUAGE = "internvl-tiny"
STATE_DIM, PADDED, HORIZON = 4, 6, {"words": 6, "pooled": 1}


def save(kind: str, folder: Path) -> Path:
    """A policy and, beside it, the files of its language model. Returns the policy's directory."""
    return unpack(SAVED / kind, folder, weights)


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
    return drawn_frame(call, STATE_DIM, dict.fromkeys(CAMERAS, SIZES[call]))


def noise(kind: str) -> Array:
    """``[1, T, D]``, in -1..1; lerobot draws the same numbers in 0..1."""
    drawn = np.random.RandomState(7).uniform(0, 1, (1, HORIZON[kind], PADDED)).astype(np.float32)
    return drawn * 2 - 1
