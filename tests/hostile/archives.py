"""Zip files that lie: names that leave the folder, links, bombs, sizes and offsets that are not so."""

import random
import stat
import struct
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

from tests.hostile.mutate import TEXTS, damaged

NAMES = (
    "../outside",
    "../../outside",
    "/tmp/outside",
    "..\\outside",
    "a/../../outside",
    "C:\\outside",
    "./manifest.json",
    "folder//manifest.json",
    "MANIFEST.JSON",
    "manifest.json ",
    "manifest.json/",
    "con",
    "a" * 300,
    "weights.safetensors\x00.txt",
    "\u2025/outside",
    *TEXTS,
)
MODES = (stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFIFO, stat.S_IFREG)


def write(path: Path, files: Mapping[str, bytes], rng: random.Random, *, deflate: bool | None = None) -> None:
    """An archive of the files as it should be; stored, or deflated if ``deflate``, or either."""
    compressed = rng.random() < 0.5 if deflate is None else deflate
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def write_hostile(path: Path, files: Mapping[str, bytes], rng: random.Random) -> None:
    """The same with one or two things wrong."""
    entries = [(zipfile.ZipInfo(name), content) for name, content in files.items()]
    kind = rng.randrange(8)
    if kind == 0:
        info = zipfile.ZipInfo(rng.choice(NAMES) or "x")
        entries.insert(rng.randrange(len(entries) + 1), (info, rng.randbytes(rng.choice((0, 10, 1000)))))
    elif kind == 1:
        rng.choice(entries)[0].filename = rng.choice(NAMES) or "x"
    elif kind == 2:
        rng.choice(entries)[0].external_attr = (rng.choice(MODES) | 0o777) << 16
    elif kind == 3:
        entries.append(rng.choice(entries))
    elif kind == 4:
        name, content = rng.choice(list(files.items()))
        entries.append((zipfile.ZipInfo(rng.choice((name.upper(), name.swapcase(), f"x/{name}"))), content))
    elif kind == 5:
        place = rng.randrange(len(entries))
        entries[place] = (entries[place][0], bytes(rng.choice((2**20, 2**24))))
    elif kind == 6:
        entries += [(zipfile.ZipInfo(f"file{i}"), b"") for i in range(rng.choice((10, 5000)))]
    compression = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", compression) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for info, content in entries:
            try:
                info.compress_type = compression if content else zipfile.ZIP_STORED
                archive.writestr(info, content, info.compress_type, 1)
            except (ValueError, UnicodeError, struct.error):
                archive.writestr("other", content)
    if rng.random() < 0.5:
        path.write_bytes(_lying(rng, path.read_bytes()))


def _lying(rng: random.Random, content: bytes) -> bytes:
    """Numbers of a header replaced: of an entry, of the directory or of its end."""
    if rng.random() < 0.3:
        return damaged(rng, content)
    signature = rng.choice((b"PK\x01\x02", b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06"))
    places = [i for i in range(len(content) - 46) if content[i : i + 4] == signature]
    if not places:
        return damaged(rng, content)
    data, place = bytearray(content), rng.choice(places)
    field, width = rng.choice(((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (42, 4), (38, 4)))
    value = rng.choice((0, 1, 8, 9, 14, 99, 2**16 - 1, 2**31 - 1, 2**32 - 2, 2**32 - 1, rng.randrange(2**32)))
    data[place + field : place + field + width] = (value % 2 ** (8 * width)).to_bytes(width, "little")
    return bytes(data)
