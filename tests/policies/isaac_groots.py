"""Tiny GR00T N1.7 policies as NVIDIA's code saved them, with weights that a seed gives: golden files stay small.

``golden/make_groot.py`` wrote the folders, and gave that code the same weights, observations and noise.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from ttscompile.core.spec import Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions

from . import groots
from .vlas import MASK, SHAPES, TOKENS, Array

KINDS = ("droid", "arm", "still")
"""The first has actions relative to a pose and to joints, and two frames a camera; the others differ in what is done to
pictures and numbers."""
TAGS = {"droid": "oxe_droid_relative_eef_relative_joint", "arm": "new_embodiment", "still": "libero_sim"}
NUMBERS = {"droid": 2, "arm": 3, "still": 0}
"""Of the embodiments, as each folder's own table has them."""
TASKS = ("Push the block!", "lift it")
SAVED = Path(__file__).parent / "golden" / "groot"
BACKBONE = "Cosmos-Reason2-2B"
PADDED_STATE, PADDED, HORIZON = 17, 14, 6
CAMERAS: dict[str, tuple[str, ...]] = {"droid": ("out", "wrist"), "arm": ("front", "wrist"), "still": ("image",)}
FRAMES: dict[str, list[int]] = {"droid": [-15, 0], "arm": [0], "still": [-1, 0]}
SIZES: dict[str, tuple[Any, Any]] = {
    "droid": ((32, 32), (50, 50)),
    "arm": ({"front": [24, 40], "wrist": [30, 30]}, {"front": [24, 24], "wrist": [61, 37]}),
    "still": ((48, 64), (31, 24)),
}
"""Height and width of the pictures of each call. Those of the last kind are not padded to squares."""
STATES: dict[str, dict[str, int]] = {
    "droid": {"eef_9d": 9, "gripper": 1, "joints": 2},
    "arm": {"waist": 2, "arm": 3, "hand": 2},
    "still": {"x": 1, "pad": 2},
}
ACTIONS: dict[str, dict[str, int]] = {
    "droid": {"eef_9d": 9, "gripper": 1, "joints": 2},
    "arm": {"arm": 3, "hand": 2},
    "still": {"x": 1, "y": 1, "gripper": 1},
}
ZOOMS = (
    ((48, 64), (24, 32)),
    ((30, 40), (10, 20)),
    ((20, 20), (8, 8)),
    ((21, 27), (32, 41)),
    ((51, 55), (16, 16)),
    ((20, 30), (25, 17)),
    ((7, 1), (3, 3)),
)
"""Heights and widths before and after, that OpenCV is asked for: one half, whole parts, others, and larger ones."""
STEPS = {"droid": 6, "arm": 4, "still": 5}


def sizes(kind: str, call: int) -> dict[str, tuple[int, int]]:
    """Height and width of each camera's pictures."""
    own = SIZES[kind][call]
    return {key: tuple(own[key] if isinstance(own, dict) else own) for key in CAMERAS[kind]}


def save(kind: str, folder: Path, call: int) -> Path:
    """A policy for pictures of this call, and the files of its backbone beside it. Returns the policy's directory."""
    shutil.copytree(SAVED / kind, folder, dirs_exist_ok=True)
    shutil.copytree(SAVED / BACKBONE, folder / BACKBONE, dirs_exist_ok=True)
    directory = folder / "policy"
    made = weights(json.loads((directory / SHAPES).read_text()))
    (directory / SHAPES).unlink()
    names = list(made)
    files = {f"model-0000{i + 1}-of-00002.safetensors": names[i::2] for i in range(2)}
    for file, own in files.items():
        save_file({name: made[name] for name in own}, directory / file)
    index = {"weight_map": {name: file for file, own in files.items() for name in own}}
    (directory / "model.safetensors.index.json").write_text(json.dumps(index))
    path = directory / "config.json"
    found = {key: list(size) for key, size in sizes(kind, call).items()}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"image_size": found}))
    return directory


def weights(shapes: Mapping[str, list[int]]) -> dict[str, torch.Tensor]:
    """By the names and shapes that are saved."""
    found = groots.weights(dict(shapes))
    # Actions that are all out of range would be clipped, and tell of nothing.
    return {name: value * (0.3 if ".action_decoder.layer2." in name else 1) for name, value in found.items()}


def statistics(kind: str) -> dict[str, Any]:
    """Of one embodiment; some numbers never moved, or nearly so."""
    rng = np.random.RandomState(3)
    found: dict[str, Any] = {"state": {}, "action": {}, "relative_action": {}}
    for part, groups in (("state", STATES[kind]), ("action", ACTIONS[kind]), ("relative_action", ACTIONS[kind])):
        for name, count in groups.items():
            shape = (STEPS[kind], count) if part == "relative_action" else (count,)
            low = rng.uniform(-1.5, -0.3, shape)
            mean, high = low + rng.uniform(0.2, 0.8, shape), low + rng.uniform(1, 2, shape)
            deviation = rng.uniform(0.3, 1, shape)
            if part != "relative_action" and name in ("gripper", "hand", "pad"):
                high[-1], deviation[-1] = low[-1] * (1 + 1e-6 * (part == "state")), 0
            own = {"min": low - 0.1, "max": high + 0.1, "mean": mean, "std": deviation, "q01": low, "q99": high}
            if kind == "still":
                own |= {"min": low, "max": high}
            found[part][name] = {key: value.tolist() for key, value in own.items()}
    return found


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame, or those that are shown, ``[T, ...]`` each; and one state."""
    rng = np.random.RandomState(call + 11)
    found: dict[str, Array] = {"state": rng.standard_normal((1, sum(STATES[kind].values()))).astype(np.float32)}
    for key, size in sizes(kind, call).items():
        pixels = rng.randint(0, 256, (len(FRAMES[kind]), 3, *size))
        found[f"video.{key}"] = (pixels / np.float32(255)).astype(np.float32)
    return found


def eager(directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
    """The whole chunk of the rebuilt network, not compiled, in robot units."""
    module, spec = load_checkpoint_policy(directory, options=options)
    seen = {key: value[None] for key, value in observation(kind, call).items() if key in spec.observations}
    if spec.instruction is not None:
        length = spec.observations[TOKENS].shape[0]
        own = Tokenizer(directory.parent / BACKBONE, CheckpointError).of_task(TASKS[call], spec.instruction, length)
        seen[TOKENS], seen[MASK] = padded([own], length)
    obs = {key: torch.from_numpy(value) for key, value in seen.items()}
    sample = eager_policy(module, spec)(obs, Noise(noise())).numpy()
    found: Array = spec.chunk.unnormalized(sample, spec.chunk.reference(seen))
    return found


def zooms() -> list[tuple[tuple[int, int], Array]]:
    """Sizes that OpenCV resizes pictures to, and the pictures."""
    rng = np.random.RandomState(0)
    return [(after, rng.randint(0, 256, (*before, 3)).astype(np.uint8)) for before, after in ZOOMS]


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(7).standard_normal((1, HORIZON, PADDED)).astype(np.float32)
