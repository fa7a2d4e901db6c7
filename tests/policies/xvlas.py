"""Tiny xvla policies, as lerobot saved them, with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_xvla.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from .hybrid import fill
from .lerobot_tiny import change_json
from .vlas import CAMERAS, Array, drawn_frame

KINDS = ("ee6d", "auto", "so101")
"""The second has other entries where there is a choice, and files as earlier versions of lerobot wrote them."""
MODES = ("joint", "agibot_ee6d", "franka_joint7")
"""Action modes of which a policy is like the last kind's."""
TASKS = ("push the block", "a task of more words than the policy reads, which is cut before its end")
SIZES = ((28, 36), (50, 40))
"""Height and width of the images of each call; those that are not resized have the first."""
SAVED = Path(__file__).parent / "golden" / "lerobot_xvla"
LANGUAGE, SHAPES = "bart-tiny", "shapes.json"
STATE_DIM, HORIZON, ACTIONS = 7, 5, {"auto": 9, "joint": 14}
"""Numbers of an action in the network, where they are not 20."""


def save(kind: str, folder: Path) -> Path:
    """A policy of a kind or a mode and, beside it, the files of its tokenizer. Returns the policy's directory."""
    directory = folder / "policy"
    shutil.copytree(SAVED / (kind if kind in KINDS else KINDS[-1]), directory)
    shutil.copytree(SAVED / LANGUAGE, folder / LANGUAGE)
    shapes = json.loads((directory / SHAPES).read_text())
    (directory / SHAPES).unlink()
    if kind in MODES:
        change_json(directory / "config.json", action_mode=kind)
        domains, most = shapes["model.transformer.action_decoder.bias.weight"]
        width = shapes["model.transformer.action_encoder.bias.weight"][1]
        actions = ACTIONS.get(kind, most)
        shapes["model.transformer.action_decoder.bias.weight"] = [domains, actions]
        shapes["model.transformer.action_decoder.fc.weight"] = [domains, actions * width]
        shapes["model.transformer.action_encoder.fc.weight"][1] -= (most - actions) * width
    save_file(weights(shapes), directory / "model.safetensors")
    return directory


def normalise(directory: Path, cameras: list[str]) -> None:
    """Have only the images of these normalised by the colours of ImageNet."""
    path = directory / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    (own,) = (step["config"] for step in steps if step["registry_name"] == "xvla_imagenet_normalize")
    own["image_keys"] = cameras
    change_json(path, steps=steps)


def weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that lerobot saves."""
    return fill({name: torch.empty(shape) for name, shape in shapes.items()}, 5)


def observation(call: int, kind: str = "ee6d") -> dict[str, Array]:
    """One frame; of the second call the state is another, and so is the size of images that are resized."""
    return drawn_frame(call, STATE_DIM, dict.fromkeys(CAMERAS, SIZES[call if kind == "ee6d" else 0]))


def noise(kind: str) -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, ACTIONS.get(kind, 20))).astype(np.float32)
