"""Tiny GR00T N1.7 policies whose actions are relative to the pose of an end effector, as lerobot saved them.

``golden/make_lerobot_groot_eef.py`` wrote the folders, and gave lerobot the same weights, observations and noise.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from . import groots
from .vlas import STATE, Array

SAVED = Path(__file__).parent / "golden" / "lerobot_groot_eef"
BACKBONE = groots.SAVED / "native" / groots.BACKBONE
"""Its files are those of ``groots``."""
KINDS = ("arm", "alone")
"""A pose, joints and a gripper as of ``oxe_droid_relative_eef_relative_joint``; and a pose alone."""
STATE_PADDED, PADDED = 14, 13
STEPS = groots.HORIZON - 1
"""Of which there are ranges."""
_POSE = ("RELATIVE", "EEF", "XYZ_ROT6D")
GROUPS: dict[str, list[tuple[str, str, tuple[str, str, str], int]]] = {
    "arm": [
        ("joint_position", "joint_position", ("RELATIVE", "NON_EEF", "DEFAULT"), 2),
        ("eef_9d", "wrist", _POSE, 9),
        ("gripper_position", "gripper_position", ("ABSOLUTE", "NON_EEF", "DEFAULT"), 1),
    ],
    "alone": [("eef_9d", "eef_9d", _POSE, 9)],
}
"""Of the actions, in their order: name, that of the state that it is relative to, how, and how many numbers."""
STATES = {"arm": {"wrist": 9, "gripper_position": 1, "joint_position": 2}, "alone": {"eef_9d": 9}}
"""Of the state, in another order."""
TURNS = ([0.36, 0.48, -0.8, -0.8, 0.6, 0.0], [-1.1, 1e-4, 0.0, 0.2, -0.9, 1e-4])
"""Two rows as measured, by call: orthonormal; and nearly a half turn, not orthonormal."""


def width(kind: str) -> int:
    """Numbers of an action, and of a state."""
    return sum(STATES[kind].values())


def state(kind: str, call: int) -> Array:
    """Of one stream."""
    rng = np.random.RandomState(call + 50)
    rest = rng.uniform(-1, 1, width(kind) - 9)
    return np.concatenate([rng.uniform(-0.5, 0.5, 3), TURNS[call], rest]).astype(np.float32)


def observation(kind: str, call: int) -> dict[str, Array]:
    """One frame of one stream, without its axis."""
    return groots.observation(call) | {STATE: state(kind, call)}


def both(kind: str) -> dict[str, Array]:
    """Two streams that see the same and measure what differs."""
    one = {key: np.stack([value, value]) for key, value in groots.observation(0).items()}
    return one | {STATE: np.stack([state(kind, call) for call in (0, 1)])}


def noise(streams: int = 1) -> Array:
    """``[B, T, D]``."""
    return np.random.RandomState(8).standard_normal((streams, groots.HORIZON, PADDED)).astype(np.float32)


def save(kind: str, folder: Path) -> Path:
    """A policy and, beside it, the files of its base and backbone. Returns the policy's directory."""
    shutil.copytree(BACKBONE, folder / groots.BACKBONE)
    return groots.save(kind, folder, SAVED)


def modality(kind: str) -> dict[str, Any]:
    """As the base's ``processor_config.json`` says it of an embodiment."""
    configs = [
        dict(zip(("rep", "type", "format"), how, strict=True)) | {"state_key": own} for _, own, how, _ in GROUPS[kind]
    ]
    return {
        "state": {"modality_keys": list(STATES[kind]), "delta_indices": [0]},
        "action": {
            "modality_keys": [name for name, *_ in GROUPS[kind]],
            "delta_indices": list(range(STEPS)),
            "action_configs": configs,
        },
        "video": {"modality_keys": ["wrist", "front"], "delta_indices": [-1, 0]},
    }


def statistics(kind: str) -> dict[str, Any]:
    """As its ``statistics.json`` says it: where actions are relative a row for each step, wider from step to step."""
    rng = np.random.RandomState(9)
    found: dict[str, Any] = {"state": {}, "action": {}, "relative_action": {}}
    found["state"] |= {key: _spread(np.full(count, -1.0), np.full(count, 1.0)) for key, count in STATES[kind].items()}
    for name, _, how, count in GROUPS[kind]:
        found["action"][name] = _spread(rng.uniform(-1, 0, count), rng.uniform(0.5, 1, count))
        if how[0] == "RELATIVE":
            middle = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0]) if how[1] == "EEF" else np.zeros(count)
            reach = np.linspace(0.2, 0.9, STEPS)[:, None] * rng.uniform(0.5, 1, (2, 1, count))
            found["relative_action"][name] = _spread(middle - reach[0], middle + reach[1])
    return found


def _spread(low: Array, high: Array) -> dict[str, Any]:
    own = {"min": low, "max": high, "mean": (low + high) / 2, "std": (high - low) / 4, "q01": low + 0.01}
    return {name: value.tolist() for name, value in (own | {"q99": high - 0.01}).items()}
