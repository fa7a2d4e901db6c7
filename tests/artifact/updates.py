"""New plans, and a new pruner, for the policy of two blocks."""

from pathlib import Path
from typing import Any

import numpy as np

from tests.plans import store_schedules
from ttscompile.artifact import load_artifact
from ttscompile.artifact.manifest import Manifest

PLAN = np.array([[0, 0], [1, 2], [0, 3]], np.int8)
RECORD = {"strategy": "tts", "plans": {"tts": {"sparsity": 0.75}, "mine": {"sparsity": 0.5}}, "losses": [1.5, None]}


def new_pruner(path: Path, by: float = 1) -> dict[str, np.ndarray]:
    pruner = {name: np.array(value) for name, value in load_artifact(path).pruner.items()}
    pruner["pruner.weight"] += by
    pruner["pruner.bias"] += by
    return pruner


def update(path: Path, by: float = 1, **changes: Any) -> Manifest:
    arguments: dict[str, Any] = {
        "pruner_weights": new_pruner(path, by),
        "schedules": {"mine": PLAN},
        "default_plan": "tts",
        "record": RECORD,
    }
    return store_schedules(path, **{**arguments, **changes})
