"""Tiny GR00T N1.7 policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_groot.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import json
from pathlib import Path

import numpy as np
import torch

from .hybrid import fill
from .vlas import CAMERAS, SHAPES as SHAPES, STATE, Array, drawn_frame, unpack

KINDS = ("words", "native")
"""The second has statistics and groups of its base, two frames a camera, and differs in rarer entries."""
TASKS = ("Push the block!", "lift it")
SIZES = ((24, 24), (40, 30))
"""Height and width of the images of each call."""
SAVED = Path(__file__).parent / "golden" / "lerobot_groot"
BASE, BACKBONE = "gr00t-tiny", "Cosmos-Reason2-2B"
STATE_DIM, ACTION_DIM, STATE_PADDED, PADDED, HORIZON = 4, 5, 6, 7, 6


def save(kind: str, folder: Path, saved: Path = SAVED) -> Path:
    """A policy and, beside it, the files of its base and backbone. Returns the policy's directory."""
    return unpack(saved / kind, folder, weights)


def with_liberos_rule(policy: Path) -> None:
    """Of a policy that is saved: its gripper is told by LIBERO's rule, and is often beyond a half and often below."""
    config = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps(config | {"action_decode_transform": "libero"}))
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        told = json.loads((policy / name).read_text())
        for step in told["steps"]:
            if step["config"].get("raw_stats"):
                step["config"]["raw_stats"]["action"]["gripper"] |= {"q01": [-0.2], "q99": [1.6]}
        (policy / name).write_text(json.dumps(told))


def without_clipping(policy: Path) -> None:
    """Of a policy that is saved: a state may be out of range."""
    path = policy / "policy_preprocessor.json"
    told = json.loads(path.read_text())
    (own,) = (step["config"] for step in told["steps"] if "clip_outliers" in step["config"])
    own["clip_outliers"] = False
    path.write_text(json.dumps(told))


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    drawn = fill({name: torch.empty(shape) for name, shape in shapes.items()}, 5)
    # Weights of each embodiment are [kinds, before, after]; ``fill`` takes all but the first for inputs.
    return {name: 1.5 * value if name.endswith(".W") else value for name, value in drawn.items()}


def observation(call: int) -> dict[str, Array]:
    """One frame; of the second call's images the size is another, and so is the state."""
    return drawn_frame(call + 3, STATE_DIM, dict.fromkeys(CAMERAS, SIZES[call]))


def far() -> dict[str, Array]:
    """A frame of which the state is far out of range."""
    given = observation(0)
    return given | {STATE: given[STATE] * 20}


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, PADDED)).astype(np.float32)
