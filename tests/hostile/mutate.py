"""Damage: of bytes, and of JSON documents."""

import copy
import os
import random
from pathlib import Path
from typing import Any

INTERESTING = (
    b"\x00",
    b"\xff",
    b"\x7f\xff\xff\xff",
    b"\x80\x00\x00\x00",
    b"\xff" * 8,
    b"\xff" * 7 + b"\x7f",
    b"{",
    b"[",
)

NUMBERS = (
    0,
    -1,
    1,
    2,
    3,
    7,
    255,
    2**31 - 1,
    2**31,
    2**32,
    2**40,
    2**53,
    2**63 - 1,
    2**63,
    -(2**63),
    10**40,
    0.5,
    -0.0,
    1e-45,
)
NUMBERS_NOT_JSON = (float("nan"), float("inf"), float("-inf"))
TEXTS = (
    "",
    "B",
    "0*B",
    "999999999*B",
    "dense",
    "..",
    "../../outside",
    "/etc/passwd",
    "a\\b",
    "weights.safetensors",
    "manifest.json",
    "float32",
    "object",
    "bool",
    "\ud800",
    "\x00",
    "a" * 5000,
    "é\u202e",
    "null",
    "${a.b}",
    "${eval:'9**9**9**9'}",
    "__class__",
)


def damaged(rng: random.Random, content: bytes) -> bytes:
    """The bytes after one to four changes; they may be the same by chance."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        place = rng.randrange(len(data) + 1)
        kind = rng.randrange(8)
        if kind <= 2 and data:
            data[place % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 3:
            del data[place:]
        elif kind == 4:
            piece = rng.choice(INTERESTING)
            data[place : place + len(piece)] = piece
        elif kind == 5:
            data[place:place] = rng.randbytes(rng.choice((1, 2, 8, 64)))
        elif kind == 6:
            del data[place : place + rng.choice((1, 2, 8, 64))]
        elif data:
            other, length = rng.randrange(len(data)), rng.choice((1, 4, 16, 256))
            data[place : place + length] = data[other : other + length]
    return bytes(data)


def anything(rng: random.Random, depth: int = 0) -> Any:
    """A JSON value of any kind."""
    kind = rng.randrange(9)
    if kind <= 2:
        return rng.choice(NUMBERS)
    if kind <= 4:
        return rng.choice(TEXTS)
    if kind == 5:
        return rng.choice((None, True, False))
    if kind == 6 and rng.random() < 0.2:
        return rng.choice(NUMBERS_NOT_JSON)
    if kind == 7 and depth < 3:
        return [anything(rng, depth + 1) for _ in range(rng.randrange(4))]
    if kind == 8 and depth < 3:
        return {rng.choice(TEXTS): anything(rng, depth + 1) for _ in range(rng.randrange(4))}
    return nested(rng.choice((10, 70, 300))) if rng.random() < 0.1 else rng.randrange(-4, 40)


def nested(depth: int) -> Any:
    """A list in a list in a list."""
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def changed(rng: random.Random, document: Any) -> Any:
    """A copy of a document of dictionaries and lists after one to three changes at places drawn at random."""
    document = copy.deepcopy(document)
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = _places(document)
        if not places:
            return anything(rng)
        _change(rng, *rng.choice(places), places)
    return document


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Container and key of everything inside."""
    found: list[tuple[Any, Any]] = []
    pending = [document]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            keys: list[Any] = list(item)
        elif isinstance(item, list):
            keys = list(range(len(item)))
        else:
            continue
        found += [(item, key) for key in keys]
        pending += [item[key] for key in keys]
    return found


def _change(rng: random.Random, container: Any, key: Any, places: list[tuple[Any, Any]]) -> None:
    value, kind = container[key], rng.randrange(10)
    if kind == 0:
        del container[key]
    elif kind == 1 and isinstance(container, list):
        container[key:key] = [copy.deepcopy(value)] * rng.choice((1, 2, 40))
    elif kind == 1:
        container[rng.choice(TEXTS)] = copy.deepcopy(value)
    elif kind == 2:
        other, name = rng.choice(places)
        container[key] = copy.deepcopy(other[name] if _holds(other, name) else None)
    elif kind == 3 and isinstance(value, list):
        rng.shuffle(value)
    elif kind <= 6 and isinstance(value, int | float) and not isinstance(value, bool):
        container[key] = rng.choice((value + 1, value - 1, -value, value * 2, 0, float(value), rng.choice(NUMBERS)))
    elif kind <= 6 and isinstance(value, str):
        similar = [other[name] for other, name in places if _holds(other, name) and isinstance(other[name], str)]
        container[key] = rng.choice((rng.choice(TEXTS), rng.choice(similar or [""]), value + "x", value.upper()))
    else:
        container[key] = anything(rng)


def make_no_file(rng: random.Random, path: Path, kind: int) -> None:
    """Make a link (0), a directory (1) or a pipe (2) where a file is expected."""
    if kind == 0:
        path.symlink_to(rng.choice(("/etc/passwd", "/dev/zero", "/dev/stdin", ".", path.name)))
    elif kind == 1:
        path.mkdir()
    else:
        os.mkfifo(path)


def _holds(container: Any, key: Any) -> bool:
    return key in container if isinstance(container, dict) else key < len(container)
