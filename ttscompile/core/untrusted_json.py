"""The one reader of JSON that somebody else wrote: manifests, configurations of checkpoints, recordings."""

import json
import math
import re
from contextlib import suppress
from typing import Any, NoReturn

MAX_DEPTH = 64
"""Levels below the root, which is level 0."""
MAX_VALUES = 500_000
"""Values below the root, counted by what stands before one. Push-T has 12,000 in its graphs. Parsed, an empty object
takes fifty times its bytes, and a reader of records takes some microseconds for it."""

_NO_TEXT = re.compile("[\ud800-\udfff]")
NOT_SHOWN = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def parse_json(
    content: bytes, limit: int, *, values: int = MAX_VALUES, allow_nan: bool = False, shown: bool = False
) -> Any:
    """Parse UTF-8 JSON without a key twice, numbers or texts that JSON does not have, or absurd size, number or depth.

    Args:
        values: limit of those, as ``most_values`` counts them.
        allow_nan: accept NaN and infinity, as ``json.dumps`` writes them.
        shown: refuse texts and keys that a terminal does not show as they are: control characters, and those that turn
            the direction of writing.

    Raises:
        ValueError: not such a document; says why, in words that follow the name of the file.
    """
    if len(content) > limit:
        raise ValueError(f"it has more than {limit:,} bytes")
    if most_values(content) > values:
        raise ValueError(f"it has more than {values:,} values")
    numbers: dict[str, Any] = {} if allow_nan else {"parse_constant": _no_constant, "parse_float": _finite}
    with suppress(RecursionError):
        data = json.loads(content.decode("utf-8"), object_pairs_hook=_unique, **numbers)
        level = [data]
        plain = content.isascii() and not re.search(rb"[\\\x7f]", content)
        for _ in range(MAX_DEPTH + 1):
            if not plain:
                _require_shown(level, NOT_SHOWN if shown else _NO_TEXT)
            held = [item for item in level if isinstance(item, dict | list)]
            level = [child for item in held for child in (item.values() if isinstance(item, dict) else item)]
            if not level:
                return data
    raise ValueError(f"it is more than {MAX_DEPTH} levels deep")


def most_values(content: bytes) -> int:
    """No fewer than the values of a JSON document: before each stands a comma or a bracket. Takes no memory."""
    return sum(map(content.count, (b",", b"[", b"{")))


def _require_shown(level: list[Any], unseen: re.Pattern[str]) -> None:
    for item in level:
        for text in item if isinstance(item, dict) else (item,):
            if isinstance(text, str) and unseen.search(text):
                raise ValueError(f"it has a text with characters that cannot be shown, {text!a:.80}")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict[str, Any]()
    for key, value in pairs:
        if key in members:
            raise ValueError(f"the key {key!a:.80} is twice in one object")
        members[key] = value
    return members


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it has the number {name}, which is not JSON")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"the number {text:.40} is too large")
    return number
