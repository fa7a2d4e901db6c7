"""safetensors files: read and written with numpy alone, an array at a time.

Layout of a file: length of the header (8 bytes, little-endian); header (JSON: name -> dtype, shape, offsets into the
data); data. Files of weights have float32 in 16 bits where that changes no number (``short``).
Source: the format's description, https://github.com/huggingface/safetensors#format.
"""

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from ..core.coercion import Array, Arrays
from ..core.rules import MAX_RANK
from ..core.untrusted_json import MAX_VALUES, most_values
from ..errors import ArtifactChangedError, ArtifactError
from .files import opened, write_synced
from .short import SHORT, ShortArray, parts, short_code
from .strict_json import REMEDY, Value, parse

MAX_HEADER_BYTES = 64 * 2**20
MAPPED = 2**23
"""Bytes of a file from which on it is mapped. Smaller files are read whole: if a mapped file is cut short while it is
read, the process dies."""

_PREFIX = 8
_DTYPES: Mapping[str, np.dtype[Any]] = MappingProxyType(
    {
        "BOOL": np.dtype(np.bool_),
        "U8": np.dtype(np.uint8),
        "I8": np.dtype(np.int8),
        "I16": np.dtype("<i2"),
        "I32": np.dtype("<i4"),
        "I64": np.dtype("<i8"),
        "F32": np.dtype("<f4"),
        "F64": np.dtype("<f8"),
    }
)
_WIDEST_FIRST = ("I64", "F64", "F32", "I32", "BF16", "F16", "I16", "I8", "U8", "BOOL")


@dataclass(frozen=True)
class Entry:
    """Where one tensor of type ``code`` lies: its first byte from the start of the file, and how many there are."""

    code: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    length: int


def require_few(paths: Iterable[Path], where: object) -> None:
    """Raise ArtifactError if the headers of these files together have more values than JSON may have."""

    def values(path: Path) -> int:
        with opened(path) as file:
            return most_values(_content(file, path))

    if (total := sum(map(values, paths))) > MAX_VALUES:
        raise ArtifactError(f"{where}: expected headers with at most {MAX_VALUES:,} values; found {total:,}. {REMEDY}")


def _content(file: BufferedReader, path: Path) -> bytes:
    """The JSON of a header."""
    size = os.fstat(file.fileno()).st_size
    prefix = file.read(_PREFIX)
    length = int.from_bytes(prefix, "little")
    if len(prefix) < _PREFIX or length > min(MAX_HEADER_BYTES, size - _PREFIX):
        raise _error(path, f"a header of at most {MAX_HEADER_BYTES} bytes inside the file", f"{size} bytes")
    return file.read(length)


def _header(file: BufferedReader, path: Path, short: bool) -> dict[str, Entry]:
    """The entries in the order of their data.

    Refused are dtypes that numpy lacks, sizes that contradict each other, and data that overlap, have gaps, are not
    aligned or lie outside of the file.
    """
    content, size = _content(file, path), os.fstat(file.fileno()).st_size
    root = parse(content, path.name, MAX_HEADER_BYTES)
    members = root.members()
    if "__metadata__" in members:
        for value in members.pop("__metadata__").members().values():
            value.text()
    start = _PREFIX + len(content)
    known = {**_DTYPES, **SHORT} if short else _DTYPES
    entries = sorted(
        ((name, _entry(value, start, known)) for name, value in members.items()),
        key=lambda item: (item[1].offset, item[1].length),
    )
    end = start
    for name, entry in entries:
        if entry.offset != end or entry.offset % entry.dtype.itemsize:
            raise _error(path, f"the data of {name!r} at byte {end}, aligned", f"byte {entry.offset}")
        end += entry.length
    if end != size:
        raise _error(path, f"{end} bytes", f"{size}")
    return dict(entries)


def entries_of(path: Path) -> dict[str, Entry]:
    """Where each tensor of a file lies."""
    with opened(path) as file:
        return _header(file, path, short=True)


def read(path: Path, short: bool = False) -> Arrays:
    """Read a safetensors file, or map it into memory if it is large.

    Returns:
        Read-only arrays. Of a file of ``MAPPED`` bytes or more they are views: nothing is read before it is used. With
        ``short`` the file may have float32 in 16 bits; each of these is a ``ShortArray``.

    Raises:
        ArtifactChangedError: the file has become shorter meanwhile.
    """
    with opened(path) as file:
        size, entries = os.fstat(file.fileno()).st_size, _header(file, path, short)
        if size < MAPPED:
            file.seek(0)
            data: Array = np.frombuffer(file.read(), np.uint8)
        else:
            data = np.memmap(file, dtype=np.uint8, mode="r").view(np.ndarray)
    if len(data) < size:
        raise ArtifactChangedError(f"{path.name}: the file was changed while it was being read. Load it again.")
    found = dict[str, Array]()
    for name, entry in entries.items():
        own = data[entry.offset : entry.offset + entry.length].view(entry.dtype).reshape(entry.shape)
        found[name] = cast(Array, ShortArray(own)) if entry.code in SHORT else own
    return MappingProxyType(found)


def check_arrays(
    kind: str, arrays: Arrays, wanted: Mapping[str, tuple[str, tuple[int, ...]]], where: object, remedy: str = REMEDY
) -> None:
    """Raise ArtifactError unless these are exactly the arrays that are wanted, of the wanted dtypes and shapes."""
    found = {name: (str(array.dtype), array.shape) for name, array in arrays.items()}
    wrong = sorted(name for name in {*wanted, *found} if wanted.get(name) != found.get(name))
    if wrong:
        both = wanted.get(wrong[0]), found.get(wrong[0])
        expected, other = ("none" if one is None else f"{one[0]}{list(one[1])}" for one in both)
        count = f" ({len(wrong)} differ)" if len(wrong) > 1 else ""
        raise ArtifactError(f"{where}: expected the {kind} {wrong[0]!r} : {expected}; found {other}{count}. {remedy}")


def serialize(arrays: Arrays) -> bytes:
    """The bytes of a safetensors file, the same whatever the order of the arrays."""
    return b"".join(_chunks(arrays))


def write(path: Path, arrays: Arrays, short: bool = False) -> None:
    """Write a new safetensors file, one array after the other: all of them together may be half of the memory."""
    write_synced(path, _chunks(arrays, short))


def _chunks(arrays: Arrays, short: bool = False) -> Iterator[bytes | memoryview]:
    """A file in parts: its header, and each array. Their order is that of the safetensors library."""
    kinds = {dtype: code for code, dtype in _DTYPES.items()}
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    for name, array in arrays.items():
        if array.dtype.newbyteorder("<") not in kinds:
            raise ArtifactError(
                f"tensor {name!r} has dtype {array.dtype}; an artifact can hold"
                f" {', '.join(str(d) for d in _DTYPES.values())}. Convert the weight before compiling."
            )
    codes = {n: (short and short_code(a)) or kinds[a.dtype.newbyteorder("<")] for n, a in arrays.items()}
    order = sorted(codes, key=lambda name: (_WIDEST_FIRST.index(codes[name]), name))
    header, end = dict[str, Any](), 0
    for name in order:
        array = arrays[name]
        size = array.nbytes // (2 if codes[name] in SHORT else 1)
        header[name] = {"dtype": codes[name], "shape": array.shape, "data_offsets": (end, end + size)}
        end += size
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _PREFIX)
    yield len(text).to_bytes(_PREFIX, "little") + text
    for name in order:
        if codes[name] in SHORT:
            yield from (short.view(np.uint8).data for _, short in parts(arrays[name], codes[name]))
            continue
        plain = np.asarray(arrays[name], dtype=arrays[name].dtype.newbyteorder("<"), order="C")
        yield plain.reshape(-1).view(np.uint8).data


def _entry(value: Value, start: int, known: Mapping[str, np.dtype[Any]]) -> Entry:
    fields = value.keys("dtype", "shape", "data_offsets")
    code = fields["dtype"].text(*known)
    shape = tuple(item.integer() for item in fields["shape"].items(MAX_RANK))
    span = [item.integer() for item in fields["data_offsets"].items()]
    dtype, length = known[code], math.prod(shape) * known[code].itemsize  # Python's integers do not overflow
    if len(span) != 2 or span[1] - span[0] != length:
        fields["data_offsets"].fail(f"[begin, begin + {length}] for {dtype}{list(shape)}")
    return Entry(code, dtype, shape, start + span[0], length)


def _error(path: Path, expected: str, found: str) -> ArtifactError:
    return ArtifactError(f"{path.name}: expected {expected}; found {found}. {REMEDY}")
