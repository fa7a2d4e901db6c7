"""Artifacts of somebody who knows the format and wants to take memory or time: sound in form, and far too much of it.

Hashes, identities and checksums are right. What is there too often, too long or too deep is drawn at random: members of
the manifest, of graphs and of headers, fields of ONNX models and entries of zips; beside files and names exchanged,
types of the calibration record changed, and texts that a terminal would obey.
"""

import json
import random
import struct
import zipfile
from collections.abc import Callable, Iterable
from io import StringIO
from pathlib import Path
from typing import Any

from tests.hostile import forged
from tests.hostile.mutate import NUMBERS, TEXTS, _places, anything, nested

COUNTS = (3, 300, 5_000, 60_000, 400_000)
TINY: tuple[Any, ...] = ([], {}, 0, "", None, [[]], {"a": []}, 1e300, 10**400, "x" * 50)
HIDDEN = ("\x1b[31m", "a\nb", "\u202e", "\ud800", "\x9b2J", "\x07")
RECORD = ("plans", "learned", "told", "skipped", "episodes", "calls", "other_noise", "budget", "seed", "strategy")
FIELDS = (1, 2, 3, 5, 7, 8, 11, 13, 14, 16, 20, 25)
SMALL = (b"", b"\x0a\x00", b"\x08\x01", b"\x12\x02\x0a\x00", b"\x22\x00")


def artifact(rng: random.Random, path: Path) -> Callable[[], None]:
    """Swell an artifact's directory; then load it, call the policy twice, and show what it holds."""
    document = json.loads((path / "manifest.json").read_text())
    for _ in range(rng.choice((1, 1, 2))):
        document = rng.choice((_manifest, _manifest, _record, _texts, _exchange, _program, _header, _model))(
            rng, path, document
        )
    forged.rehash(path, document)
    if rng.random() < 0.25:
        path = _zipped(rng, path)
    return lambda: use(path)


def use(path: Path) -> None:
    """What a user does with an artifact, and what ``inspect`` prints of it."""
    from rich.console import Console

    from ttscompile.artifact.load import load_artifact
    from ttscompile.cli.summary import print_summary
    from ttscompile.report.summary import document

    loaded = load_artifact(path)
    shown = StringIO()
    print_summary(loaded, Console(file=shown, width=100))
    json.dumps(document(loaded), allow_nan=False).encode("utf-8")
    if hidden := [c for c in shown.getvalue() if not c.isprintable() and c != "\n"]:
        raise AssertionError(f"printed {hidden[:5]!a}")
    forged.use(path)


def _manifest(rng: random.Random, path: Path, document: Any) -> Any:
    """One place of it many times, or many small values in it."""
    container, key = rng.choice(_places(document))
    value, count = container[key], rng.choice(COUNTS)
    kind = rng.randrange(5)
    if kind == 0 and isinstance(value, dict):
        model = _small(rng, value.values())
        value.update({f"{rng.choice(('x', 'block_', 'a.'))}{i}": model for i in range(count)})
    elif kind <= 1 and isinstance(value, list):
        value.extend([_small(rng, value)] * count)
    elif kind == 2:
        container[key] = rng.choice(
            ([rng.choice(TINY)] * count, dict.fromkeys(map(str, range(count)), rng.choice(TINY)))
        )
    elif kind == 3 and isinstance(container, dict):
        container["k" * count] = container.pop(key)
    else:
        container[key] = rng.choice((nested(rng.choice((60, 500))), "s" * count, rng.choice(NUMBERS)))
    return document


def _small(rng: random.Random, values: Iterable[Any]) -> Any:
    """The first of some values, unless there is none or it has been swollen itself."""
    first = next(iter(values), None)
    return first if rng.random() < 0.7 and len(str(first)) < 500 else rng.choice(TINY)


def _record(rng: random.Random, path: Path, document: Any) -> Any:
    """Of the calibration what commands read, with values of any type."""
    record: Any = document.get("calibration") or {"plans": {"schedule": {"error": 1.0, "distance": 0.5}}}
    for _ in range(rng.randrange(1, 4)):
        name = rng.choice(RECORD)
        record[name] = rng.choice((anything(rng), rng.choice(TINY), {"schedule": anything(rng)}, rng.choice(NUMBERS)))
    plans = record.get("plans")
    if isinstance(plans, dict) and rng.random() < 0.6:
        score = {key: rng.choice((1.0, -1, 10**400, "1", None, [1], True)) for key in ("error", "distance", "sparsity")}
        plans[rng.choice(("schedule", "mine", *TEXTS[:8]))] = {**score, "flops_saved": rng.choice((0.5, 10**30, "x"))}
    document["calibration"] = record
    return document


def _texts(rng: random.Random, path: Path, document: Any) -> Any:
    """A name or a text with characters that a terminal obeys."""
    places = [(c, k) for c, k in _places(document) if isinstance(c[k], str) or isinstance(k, str)]
    container, key = rng.choice(places)
    if isinstance(container[key], str) and rng.random() < 0.5:
        container[key] += rng.choice(HIDDEN)
    elif isinstance(key, str):
        container[key + rng.choice(HIDDEN)] = container.pop(key)
    return document


def _exchange(rng: random.Random, path: Path, document: Any) -> Any:
    """Two files under each other's names, or two names that the manifest gives."""
    names = sorted(each.name for each in path.iterdir() if each.name != "manifest.json")
    one, other = rng.sample(names, 2)
    if rng.random() < 0.5:
        (path / one).rename(path / "between")
        (path / other).rename(path / one)
        (path / "between").rename(path / other)
    else:
        pieces = document["pieces"]
        first, second = rng.sample(sorted(pieces), 2)
        pieces[first]["file"], pieces[second]["file"] = pieces[second]["file"], pieces[first]["file"]
    return document


def _program(rng: random.Random, path: Path, document: Any) -> Any:
    try:
        content = json.loads((path / "program.json").read_bytes())
    except ValueError:  # another file's content, by an exchange
        return document
    _manifest(rng, path, content)
    (path / "program.json").write_text(json.dumps(content))
    return document


def _header(rng: random.Random, path: Path, document: Any) -> Any:
    """Many tensors of nothing, or of many sizes."""
    victim = rng.choice(sorted(path.glob("*.safetensors")))
    content = victim.read_bytes()
    length, count = int.from_bytes(content[:8], "little"), rng.choice(COUNTS)
    try:
        header = json.loads(content[8 : 8 + length])
    except ValueError:  # another file's content, by an exchange
        return document
    if rng.random() < 0.7:
        end = len(content) - 8 - length
        empty = {"dtype": "F32", "shape": [0], "data_offsets": [end, end]}
        header |= {f"{rng.choice(('', 'table/', 'correction/'))}{i}": empty for i in range(count)}
    else:
        rng.choice([one for one in header.values() if isinstance(one, dict)])["shape"] = [1] * count
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    victim.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])
    return document


def _model(rng: random.Random, path: Path, document: Any) -> Any:
    """Fields of a few bytes, many of them, deep in each other or side by side; before or after what was there."""
    victim = rng.choice(sorted(path.glob("*.onnx")))
    content = victim.read_bytes()
    kind = rng.randrange(4)
    if kind == 0:
        more = bytes(rng.choice(COUNTS))
    else:
        small = rng.choice(SMALL)
        more = field(rng.choice(FIELDS), small) * rng.choice(COUNTS)
        for _ in range(rng.choice((0, 1, 2, 3, 40)) if kind > 1 else 1):
            more = field(rng.choice(FIELDS), more)
        more = field(7, more) if rng.random() < 0.7 else more
    victim.write_bytes(content + more if rng.random() < 0.7 else more + content)
    return document


def field(number: int, content: bytes) -> bytes:
    """A field of a message that has bytes."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def _zipped(rng: random.Random, path: Path) -> Path:
    target = path.with_suffix(".zip")
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for each in sorted(path.iterdir()):
            archive.write(each, each.name)
        if rng.random() < 0.3:
            archive.comment = rng.randbytes(rng.choice((10, 60_000)))
        for i in range(rng.choice((0, 0, 5, 3_000, 15_000))):
            archive.writestr(zipfile.ZipInfo(f"x{i}"), b"")
    return target
