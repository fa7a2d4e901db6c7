"""JSON files of a checkpoint, which other programs wrote with whatever entries those have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.untrusted_json import parse_json
from ..errors import CheckpointError

MAX_BYTES = 4 * 2**20
"""Of a configuration; in use are some 10 KB."""


def read_json(path: Path) -> dict[str, Any]:
    """The object that a file holds.

    Raises:
        CheckpointError: missing, unreadable, too large or deep, not strictly JSON, or something else than an object.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file.")
    try:
        with path.open("rb") as file:
            data = parse_json(file.read(MAX_BYTES + 1), MAX_BYTES)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read as JSON: {error!s:.300}. Copy the file again.") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path}: holds a {type(data).__name__}; expected an object.")
    return data
