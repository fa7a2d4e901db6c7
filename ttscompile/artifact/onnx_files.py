"""Where the weights of an ONNX model lie, read from its bytes with numpy's dependencies alone, that is, none.

onnxruntime opens whatever file a model names beside it. Here each of these names is held against the manifest before
onnxruntime sees the model: a file of the artifact, whose hash was checked, and a range inside it.
Source: the format of messages, https://protobuf.dev/programming-guides/encoding/, and the field numbers of onnx.proto.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from ..errors import ArtifactError
from .files import read_file
from .manifest import FileRecord
from .strict_json import REMEDY

MAX_BYTES = 512 * 2**20
MAX_DEPTH = 32

# Fields through which a tensor can be reached, by message; all others are skipped.
_FIELDS: Mapping[str, Mapping[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_EXTERNAL_DATA = 13
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def check_model(path: Path, files: Mapping[str, FileRecord]) -> None:
    """Raise unless all weights of a model are in it, or in ranges of the artifact's files, which were checked.

    Raises:
        ArtifactError: unreadable, no such model, or weights elsewhere.
    """
    content = read_file(path, MAX_BYTES) if path.suffix == ".onnx" else None
    if content is None or len(content) > MAX_BYTES:
        raise ArtifactError(f"{path}: expected a file NAME.onnx of at most {MAX_BYTES} bytes. {REMEDY}")
    try:
        places = [_entries(tensor) for tensor in _tensors(memoryview(content), "model", 0)]
    except (ValueError, IndexError) as error:
        raise ArtifactError(f"{path}: expected an ONNX model; found a message that ends amiss. {REMEDY}") from error
    for place in places:
        if place and not _fits(place, files):
            raise ArtifactError(
                f"{path}: expected weights in the model itself or in a range of a file of the artifact; found"
                f" {str(place)[:200]}. {REMEDY}"
            )


def _tensors(message: memoryview, kind: str, depth: int) -> Iterator[memoryview]:
    """All tensors below a message."""
    if depth > MAX_DEPTH:
        raise ValueError("messages too deep in each other")
    for number, value in _read(message):
        below = _FIELDS[kind].get(number)
        if below == "tensor" and value is not None:
            yield value
        elif below is not None and value is not None:
            yield from _tensors(value, below, depth + 1)


def _entries(tensor: memoryview) -> dict[str, str]:
    """The entries of ``external_data``; empty if the tensor has its data itself."""
    entries: dict[str, str] = {}
    for number, value in _read(tensor):
        if number == _EXTERNAL_DATA and value is not None:
            fields = {n: bytes(v).decode() for n, v in _read(value) if v is not None}
            key = fields.get(1, "")
            if key in entries:
                raise ValueError("an entry twice")
            entries[key] = fields.get(2, "")
    return entries


def _fits(place: Mapping[str, str], files: Mapping[str, FileRecord]) -> bool:
    location, offset, length = place.get("location", ""), place.get("offset", "0"), place.get("length", "")
    if set(place) - {"location", "offset", "length", "checksum"} or location not in files:
        return False
    if not all(text.isascii() and text.isdigit() and len(text) < 20 for text in (offset, length)):
        return False
    return int(offset) + int(length) <= files[location].bytes


def _read(message: memoryview) -> Iterator[tuple[int, memoryview | None]]:
    """Number and content of each field; None for numbers."""
    position, end = 0, len(message)
    while position < end:
        key, position = _varint(message, position)
        number, wire = key >> 3, key & 7
        if wire == _BYTES:
            size, position = _varint(message, position)
            if size > end - position:
                raise ValueError("a field beyond the message's end")
            yield number, message[position : position + size]
            position += size
            continue
        if wire == _VARINT:
            _, position = _varint(message, position)
        elif wire in (_FIXED64, _FIXED32):
            position += 8 if wire == _FIXED64 else 4
        else:
            raise ValueError("a group, which onnx does not use")
        yield number, None
    if position != end:
        raise ValueError("a field beyond the message's end")


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """A number, and where it ends."""
    value = shift = 0
    while True:
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if not byte & 0x80:
            return value, position
        shift += 7
        if shift >= 70:
            raise ValueError("a number without end")
