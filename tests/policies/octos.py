"""Two small Octos as their authors' code saved them, what they were shown, and what they did; see ``make_octo.py``."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.families.checks import Arrays, golden
from ttscompile.core.spec import Noise

WINDOW, TOKENS, MASK = "timestep_pad_mask", "language_instruction.input_ids", "language_instruction.attention_mask"
CHECKPOINT = Path("300") / "default" / "checkpoint"


def unpack(folder: Path) -> Path:
    """The folders ``one`` and ``two``, and that of the tokenizer, ``t5-base``."""
    for name, content in golden("octo").items():
        if name.startswith("file:"):
            path = folder / name.removeprefix("file:")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.tobytes())
    return folder


def change(path: Path, *changes: Callable[[dict[str, Any]], Any]) -> Path:
    """A JSON file after changes."""
    entries = json.loads(path.read_text())
    for each in changes:
        each(entries)
    path.write_text(json.dumps(entries))
    return path


def shown(model: str, case: str) -> Arrays:
    """Everything that a model may observe, of two streams."""
    arrays = golden("octo")
    images = {name.partition(".")[2]: value for name, value in arrays.items() if name.startswith(f"{model}.image_")}
    return {
        **{key: np.moveaxis(value, -1, 2).astype(np.float32) / 255 for key, value in images.items()},
        WINDOW: arrays[f"{model}.{case}.pad"],
        TOKENS: arrays[f"{model}.{case}.tokens"].astype(np.int64),
        MASK: arrays[f"{model}.{case}.mask"].astype(bool),
    }


def noise(model: str, case: str) -> Noise:
    """What the original drew."""
    arrays = golden("octo")
    return Noise(arrays[f"{model}.{case}.noise"], arrays[f"{model}.{case}.steps"])


def actions(model: str, case: str) -> np.ndarray:
    """What the original did."""
    return golden("octo")[f"{model}.{case}.actions"]
