"""Where weights of ONNX models lie, what they run and how many parts they have, read with numpy's dependencies: none.

onnxruntime opens whatever file a model names beside it, and makes an object of a hundred bytes of a message of two.
Here each of these names is held against the manifest before onnxruntime sees the model: a file of the artifact, whose
hash was checked, and a range inside it. All fields are counted, whether they lead to a tensor or not. And operators
that ``convert`` never writes are refused: those that loop, which may never end, and those of others. It writes one
``Scan``, over the heads of an attention in eight bits; that ends after as many turns as there are heads.
Source: the format of messages, https://protobuf.dev/programming-guides/encoding/, and the field numbers of onnx.proto.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from ..errors import ArtifactError
from .files import read_file
from .manifest import FileRecord
from .strict_json import REMEDY

MAX_BYTES = 64 * 2**20
"""Of all models of an artifact, whose weights lie beside them. Push-T has 0.2 MB."""
MAX_FIELDS = 500_000
"""In all models of an artifact. Push-T has 20,000."""
MAX_DEPTH = 32
LOOPS = frozenset({"Loop", "SequenceMap"})
SCAN = "Scan"
"""In each other they would have as many turns as their numbers multiplied."""
INTEGER = frozenset({"DynamicQuantizeMatMul", "MatMulIntegerToFloat", "MatMulNBits", "QuantizeLinear"})
"""What an artifact has of onnxruntime's own operators."""

_SPARSE = "sparse"
# Fields that hold messages, by message; but for messages of which each has a few numbers and texts only.
_FIELDS: Mapping[str, Mapping[int, str]] = {
    "model": {7: "graph"},
    "graph": {1: "node", 5: "tensor", 11: "value", 12: "value", 13: "value", 14: "annotation", 15: _SPARSE},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 10: "tensor", 6: "graph", 11: "graph", 14: "type", 15: "type", 22: _SPARSE, 23: _SPARSE},
    _SPARSE: {1: "tensor", 2: "tensor"},
    "tensor": {},
    "annotation": {},
    "value": {2: "type"},
    "type": {1: "array", 4: "item", 5: "map", 8: "array", 9: "item"},
    "array": {2: "shape"},
    "shape": {},
    "item": {1: "type"},
    "map": {2: "type"},
}
_EXTERNAL_DATA = 13
_OF_NODE = 4, 7  # operator and domain
_FOREIGN = {("model", 20), ("model", 25), ("node", 10)}
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def check_models(directory: Path, names: Iterable[str], files: Mapping[str, FileRecord]) -> None:
    """Raise ArtifactError unless models run what ``convert`` writes, and all weights are in them or in these files.

    A model runs operators of the standard that surely end, and those of ``INTEGER``. The files were checked.
    """
    left, names = iter(range(MAX_FIELDS)), sorted(names)  # of the fields that may still be read
    if (total := sum(files[name].bytes for name in names)) > MAX_BYTES:
        raise ArtifactError(f"{directory}: expected ONNX models of {MAX_BYTES} bytes at most; found {total}. {REMEDY}")
    for path in (directory / name for name in names):
        if path.suffix != ".onnx":
            raise ArtifactError(f"{path}: expected a file NAME.onnx. {REMEDY}")
        try:
            for place in _places(memoryview(read_file(path, MAX_BYTES)), "model", 0, left):
                if not _fits(place, files):
                    raise ArtifactError(
                        f"{path}: expected weights in the model itself or in a range of a file of the artifact; found"
                        f" {str(place)[:200]}. {REMEDY}"
                    )
        except (ValueError, IndexError) as error:
            found = error if type(error) is ValueError else "a message that ends amiss"
            raise ArtifactError(f"{path}: expected an ONNX model; found {found}. {REMEDY}") from error


def weight_bytes(directory: Path, names: Iterable[str]) -> int:
    """What these models read of the files beside them, in bytes, each weight once. They were checked."""
    models = (memoryview(read_file(directory / name, MAX_BYTES)) for name in names)
    places = (place for model in models for place in _places(model, "model", 0, iter(range(MAX_FIELDS))))
    return sum({tuple(place.items()): int(place["length"]) for place in places}.values())


def _places(
    message: memoryview, kind: str, depth: int, left: Iterator[int], scanned: bool = False
) -> Iterator[dict[str, str]]:
    """The entries of ``external_data`` of each tensor below a message that has not its data itself."""
    if depth > MAX_DEPTH:
        raise ValueError("messages too deep in each other")
    fields, entries, parts = _FIELDS[kind], dict[str, str](), _read(message, left)
    if kind == "node":
        parts = iter(known := list(parts))
        names, domains = ({bytes(v).decode() for n, v in known if n == one and v is not None} for one in _OF_NODE)
        _require_known(names, domains, scanned)
        scanned = scanned or SCAN in names
    for number, value in parts:
        if value is None:
            continue
        if number in fields:
            yield from _places(value, fields[number], depth + 1, left, scanned)
        elif kind == "tensor" and number == _EXTERNAL_DATA:
            texts = {n: bytes(v).decode() for n, v in _read(value, left) if v is not None}
            if texts.get(1, "") in entries:
                raise ValueError("an entry twice")
            entries[texts.get(1, "")] = texts.get(2, "")
        elif (kind, number) in _FOREIGN:
            raise ValueError("training, functions of its own, or devices, which convert never writes")
    if entries:
        yield entries


def _require_known(names: set[str], domains: set[str], scanned: bool) -> None:
    """Of one node; the last of each counts, and none may be foreign. Raises ValueError."""
    known = names <= INTEGER if domains - {"", "ai.onnx"} else not names & LOOPS and not (scanned and SCAN in names)
    if not known or domains - {"", "ai.onnx", "com.microsoft"}:
        told = f"{'/'.join(sorted(domains))}:{'/'.join(sorted(names))}"[:100]
        raise ValueError(f"the operator {told!a}, which convert never writes (loops, and operators of others)")


def _fits(place: Mapping[str, str], files: Mapping[str, FileRecord]) -> bool:
    location, offset, length = place.get("location", ""), place.get("offset", "0"), place.get("length", "")
    if set(place) - {"location", "offset", "length", "checksum"} or location not in files:
        return False
    if not all(text.isascii() and text.isdigit() and len(text) < 20 for text in (offset, length)):
        return False
    return int(offset) + int(length) <= files[location].bytes


def _read(message: memoryview, left: Iterator[int]) -> Iterator[tuple[int, memoryview | None]]:
    """Number and content of each field; None for numbers."""
    position, end = 0, len(message)
    while position < end:
        if next(left, None) is None:
            raise ValueError(f"more than {MAX_FIELDS:,} fields in the models of one artifact")
        key, position = _varint(message, position)
        number, wire = key >> 3, key & 7
        if number == 0:
            raise ValueError("a field without a number")
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
