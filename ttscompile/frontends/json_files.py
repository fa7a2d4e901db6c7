"""JSON files of a checkpoint, read strictly: within limits, without what JSON does not have, without a key twice.

The artifact has a reader of its own (``artifact.strict_json``), whose errors are about artifacts; this one is for files
that other programs wrote, with whatever entries those have.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NoReturn

from ..errors import CheckpointError

MAX_BYTES = 4 * 2**20
"""Of a configuration; in use are some 10 KB. Parsed, a file of brackets takes a hundred times its size."""
MAX_DEPTH = 64


def read_json(path: Path) -> dict[str, Any]:
    """The object that a file holds.

    Raises:
        CheckpointError: missing, unreadable, too large or deep, not strictly JSON, or something else than an object.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file.")
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES:,} bytes")
        data = json.loads(
            content.decode("utf-8"), object_pairs_hook=_unique, parse_constant=_no_constant, parse_float=_finite
        )
        _check_depth(data)
    except RecursionError:
        raise _unreadable(path, f"it is more than {MAX_DEPTH} levels deep") from None
    except (OSError, ValueError) as error:  # errors of decoding and of JSON are ValueErrors
        raise _unreadable(path, str(error)) from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path}: holds a {type(data).__name__}; expected an object.")
    return data


def _unreadable(path: Path, why: str) -> CheckpointError:
    return CheckpointError(f"{path}: cannot be read as JSON: {why:.300}. Copy the file again.")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members: dict[str, Any] = {}
    for key, value in pairs:
        if key in members:
            raise ValueError(f"the key {key!r:.80} is twice in one object")
        members[key] = value
    return members


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it has the number {name}, which is not JSON")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"the number {text:.40} is too large")
    return number


def _check_depth(data: object) -> None:
    level = [data]
    for _ in range(MAX_DEPTH + 1):
        below: list[object] = []
        for item in level:
            if isinstance(item, dict):
                below += item.values()
            elif isinstance(item, list):
                below += item
        if not below:
            return
        level = below
    raise ValueError(f"it is more than {MAX_DEPTH} levels deep")
