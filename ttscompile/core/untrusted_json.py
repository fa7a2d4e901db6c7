"""The one reader of JSON that somebody else wrote: manifests, configurations of checkpoints, recordings."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from typing import Any, NoReturn

MAX_DEPTH = 64
"""Levels below the root, which is level 0."""


def parse_json(content: bytes, limit: int, *, allow_nan: bool = False) -> Any:
    """Parse UTF-8 JSON without a key twice, numbers that JSON does not have, or absurd size or depth.

    Args:
        content: the document.
        limit: largest accepted size in bytes. Parsed, a document of brackets takes a hundred times its size.
        allow_nan: accept NaN and infinity, as ``json.dumps`` writes them.

    Raises:
        ValueError: not such a document; says why, in words that follow the name of the file.
    """
    if len(content) > limit:
        raise ValueError(f"it has more than {limit:,} bytes")
    numbers: dict[str, Any] = {} if allow_nan else {"parse_constant": _no_constant, "parse_float": _finite}
    with suppress(RecursionError):
        data = json.loads(content.decode("utf-8"), object_pairs_hook=_unique, **numbers)
        level = [data]
        for _ in range(MAX_DEPTH + 1):
            level = [child for item in level for child in _children(item)]
            if not level:
                return data
    raise ValueError(f"it is more than {MAX_DEPTH} levels deep")


def _children(item: object) -> Any:
    if isinstance(item, dict):
        return item.values()
    return item if isinstance(item, list) else ()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in names if names.count(key) > 1)!r:.80} is twice in one object")
    return members


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it has the number {name}, which is not JSON")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"the number {text:.40} is too large")
    return number
