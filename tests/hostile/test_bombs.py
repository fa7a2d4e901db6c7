"""Small files that would take gigabytes or minutes if they were parsed before they are measured."""

import hashlib
import json
import resource
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from tests.hostile.forged import forge, rehash
from tests.hostile.fuzz import LIMIT
from tests.hostile.guard import MORE_BYTES, address_space
from tests.untraced import untraced
from ttscompile.artifact import load_artifact, tensors
from ttscompile.artifact.codec import MAX_MANIFEST_VALUES
from ttscompile.artifact.files import read_file
from ttscompile.artifact.onnx_files import _FIELDS, MAX_BYTES
from ttscompile.artifact.strict_json import dump_compact
from ttscompile.core import untrusted_json
from ttscompile.core.spec import SamplerTable
from ttscompile.core.untrusted_json import MAX_VALUES, parse_json
from ttscompile.core.zip_files import MAX_DIRECTORY, MAX_ENTRIES, open_zip
from ttscompile.errors import ArtifactError, TrajectoryError
from ttscompile.trajectories.episodes import read_npz


def refused(load: Callable[[], object], message: str) -> None:
    """Within what docs/security.md promises of every refusal."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (address_space() + MORE_BYTES, hard))
    try:
        began = time.process_time()
        with untraced(), pytest.raises(ArtifactError, match=message) as raised:
            load()
        assert time.process_time() - began < LIMIT
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert len(str(raised.value)) < 2000


def length(value: int) -> bytes:
    """A varint of five bytes."""
    return bytes((value >> 7 * i & 0x7F) | (0x80 if i < 4 else 0) for i in range(5))


EMPTY = 2**20
MODELS = {
    "zeros": bytes(2**22),
    "a number without end": b"\xff" * 2**22,
    "nodes": b"\x3a" + length(2 * EMPTY) + b"\x0a\x00" * EMPTY,
    "fields that nobody looks at": b"\x7a\x00" * EMPTY,
    "sizes of an input": b"",
}
_DIMENSIONS = b"\x0a\x00" * EMPTY
for _key in (b"\x12", b"\x0a", b"\x12", b"\x5a", b"\x3a"):  # shape, tensor type, type, input, graph
    _DIMENSIONS = _key + length(len(_DIMENSIONS)) + _DIMENSIONS
MODELS["sizes of an input"] = _DIMENSIONS


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_millions_of_fields(written: Path, name: str) -> None:
    (written / "stem.onnx").write_bytes(MODELS[name])
    forge(written)
    refused(
        lambda: load_artifact(written),
        r"stem\.onnx: expected an ONNX model; found (more than|a message|a number|a field)",
    )


def test_fields_of_all_models_together(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ttscompile.artifact.onnx_files.MAX_FIELDS", 10)
    with pytest.raises(ArtifactError, match="more than 10 fields in the models of one artifact"):
        load_artifact(written)


def test_every_message_of_onnx_that_may_hold_many_is_read() -> None:
    """By onnx's descriptors: every field that is a message is in our table, but for small ones that hold no list."""
    pending, names = [(onnx.ModelProto.DESCRIPTOR, "model")], {onnx.ModelProto.DESCRIPTOR.name: "model"}
    while pending:
        message, name = pending.pop()
        wanted = {f.number: f.message_type for f in message.fields if f.message_type is not None}
        leaves = {number for number, below in wanted.items() if below.name in LEAVES | REFUSED}
        assert set(_FIELDS[name]) == set(wanted) - leaves, message.name
        for number in _FIELDS[name]:
            if wanted[number].name not in names:
                names[wanted[number].name] = _FIELDS[name][number]
                pending.append((wanted[number], _FIELDS[name][number]))
    assert set(names.values()) == set(_FIELDS)


LEAVES = {
    *("OperatorSetIdProto", "StringStringEntryProto", "DeviceConfigurationProto", "Segment", "Dimension", "Opaque"),
    *("IntIntListEntryProto", "SimpleShardedDimProto"),
}
REFUSED = {"TrainingInfoProto", "FunctionProto", "NodeDeviceConfigurationProto"}


def test_models_are_small(written: Path) -> None:
    with (written / "stem.onnx").open("ab") as file:
        file.truncate(MAX_BYTES)  # zeros that take no room
    forge(written)
    refused(lambda: load_artifact(written), f"expected ONNX models of {MAX_BYTES} bytes at most")


def values(count: int) -> str:
    return "[" + "{}," * (count // 2) + "{}]"


@pytest.mark.parametrize("place", ["calibration", "files", "spec"])
def test_a_manifest_of_millions_of_values(written: Path, place: str) -> None:
    document = json.loads((written / "manifest.json").read_text())
    document[place] = {"a": None}
    text = json.dumps(document).replace('{"a": null}', values(4 * MAX_VALUES))
    (written / "manifest.json").write_text(text)
    refused(lambda: load_artifact(written), f"it has more than {MAX_MANIFEST_VALUES:,} values")


def test_a_manifest_of_as_many_values_as_may_be(written: Path) -> None:
    """It is read, and refused for what it says."""

    def many(document: dict[str, Any]) -> None:
        record = document["files"].popitem()[1]
        document["files"] |= {f"f{i}": record for i in range(10_000)}
        document["calibration"] = {"a": [[]] * 20_000}

    forge(written, many)
    refused(lambda: load_artifact(written), "files: expected at most 4096 entries")


def test_a_key_that_is_long_stands_in_few_paths(written: Path) -> None:
    """Every item of a list has the path of the list in its own."""
    key = "x" * 2**20

    def long(document: dict[str, Any]) -> None:
        document["spec"]["observations"][key] = {"shape": [1] * 10_000, "dtype": 3, "normalizer": None, "fit": None}

    forge(written, long)
    refused(lambda: load_artifact(written), "expected")


def test_a_key_that_is_twice_among_many() -> None:
    names = [f'"{i}": 0' for i in range(MAX_VALUES // 2)]
    began = time.process_time()
    with untraced(), pytest.raises(ValueError, match="the key '249999' is twice"):
        parse_json(("{" + ", ".join([*names, names[-1]]) + "}").encode(), 2**26)
    assert time.process_time() - began < LIMIT


def header(entries: str) -> bytes:
    text = entries.encode() + b" " * (-len(entries) % 8)
    return struct.pack("<Q", len(text)) + text


def test_a_tensor_file_of_millions_of_entries(written: Path) -> None:
    one = '{"dtype":"F32","shape":[0],"data_offsets":[0,0]}'
    many = "{" + ",".join(f'"{i}":{one}' for i in range(MAX_VALUES // 4)) + "}"
    (written / "weights.safetensors").write_bytes(header(many))
    forge(written)
    refused(lambda: load_artifact(written), f"expected headers with at most {MAX_VALUES:,} values")
    refused(lambda: tensors.read(written / "weights.safetensors"), f"it has more than {MAX_VALUES:,} values")


def test_headers_of_all_files_together(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tensors, "MAX_VALUES", 40)
    with pytest.raises(ArtifactError, match="expected headers with at most 40 values; found"):
        load_artifact(written)


def empty_entries(path: Path, count: int, name: str = "{}") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(count):
            archive.writestr(zipfile.ZipInfo(name.format(i)), b"")
    return path


def test_a_zip_of_many_entries(tmp_path: Path) -> None:
    """The directory is not read; one that is short is, and counted."""
    many = empty_entries(tmp_path / "a.zip", 3, "x" * 60_000 + "{}")
    content = many.read_bytes()
    end = content.rindex(b"PK\x05\x06")
    start = struct.unpack("<I", content[end + 16 : end + 20])[0]
    directory = content[start:end] * 40
    assert len(directory) > MAX_DIRECTORY
    sizes = struct.pack("<HHII", 120, 120, len(directory), start)
    many.write_bytes(content[:start] + directory + content[end : end + 8] + sizes + content[end + 20 :])
    refused(lambda: load_artifact(many), "expected a directory of at most 4,194,304 bytes")
    few = empty_entries(tmp_path / "b.zip", MAX_ENTRIES + 1)
    refused(lambda: load_artifact(few), "expected at most 10,000 entries; found 10,001")
    with pytest.raises(TrajectoryError, match="expected at most 10,000 entries"):
        read_npz(few.rename(tmp_path / "b.npz"))
    with (tmp_path / "b.npz").open("rb") as file, pytest.raises(zipfile.BadZipFile):
        open_zip(file)


def test_a_small_file_takes_little_memory(tmp_path: Path) -> None:
    """Python allocates as much as it is asked to read."""
    path = tmp_path / "a"
    path.write_bytes(b"x" * 2000)
    tracemalloc.start()
    try:
        assert read_file(path, 2**29) == b"x" * 2000
        assert tracemalloc.get_traced_memory()[1] < 2**16
    finally:
        tracemalloc.stop()
    assert len(read_file(path, 1000)) == 1001, "one more than allowed says that there is more"


def test_cells_that_no_file_holds(written: Path) -> None:
    """A plan of kind ``all`` takes a line of JSON, and a byte for each step and block."""

    def many(document: dict[str, Any]) -> None:
        sampler = document["spec"]["sampler"]
        steps = 8_000
        for name in SamplerTable.COLUMNS:
            sampler[name] = [0.5] * steps
        sampler["timesteps"] = {"dtype": "int64", "shape": [steps], "values": [1] * steps}
        sampler["memory_to_next"] |= {"shape": [steps, 0]}
        sampler["to_memory"] |= {"shape": [steps, 0, 3]}
        block = document["blocks"][0]
        document["blocks"] = [block] * 1000
        document["flops"]["blocks"] = [1] * 1000
        piece = document["pieces"]["block_00"]
        document["pieces"] |= {f"block_{i:02d}": piece for i in range(1000)}
        del document["files"]["block_01.onnx"]
        record: dict[str, Any] = {
            "kind": "all",
            "loop": "original",
            "weights": "original",
            "precision": {},
            "tokens": None,
        }
        record |= {"otherwise": None, "sparsity": 0.0, "flops_sparsity": 0.0}
        document["plans"] = {f"p{i}": record for i in range(200)}

    (written / "block_01.onnx").unlink()
    forge(written, many)
    refused(lambda: load_artifact(written), "its manifest declares")


def test_numbers_count_what_they_say() -> None:
    assert untrusted_json.most_values(b'{"a": [1, 2, {"b": "c,d"}]}') >= 6
    assert untrusted_json.most_values(b"[]") == 1
    document = values(MAX_VALUES - 1000).encode()
    assert len(parse_json(document, len(document))) == (MAX_VALUES - 1000) // 2 + 1


def test_rehash_is_what_the_loader_expects(written: Path) -> None:
    """The control: forging alone is no reason to refuse."""
    rehash(written, json.loads((written / "manifest.json").read_text()))
    load_artifact(written)


@pytest.mark.parametrize("place", ["timesteps", "type", "observation", "kept"])
def test_a_shape_of_thousands_of_sizes(written: Path, place: str) -> None:
    """Their product has a million digits, and takes long to have."""
    sizes = [2**62] * 80_000

    def long(document: dict[str, Any]) -> None:
        spec = document["spec"]
        if place == "timesteps":
            spec["sampler"]["timesteps"] = {"dtype": "int64", "shape": sizes, "values": []}
        elif place == "type":
            document["blocks"][0]["type"]["shape"] = sizes
        elif place == "observation":
            spec["observations"]["goal"]["shape"] = sizes
        else:
            one = {"dtype": "float32", "shape": sizes}
            document["tokens"] = {"frame_00": {"tokens": 1, "fixed": 0, "patch": [1, 1], "kept": {"a": one}}}

    document = json.loads((written / "manifest.json").read_text())
    long(document)
    document.pop("checksum")
    checksum = hashlib.sha256(dump_compact(document)).hexdigest()
    (written / "manifest.json").write_text(json.dumps({**document, "checksum": checksum}))
    refused(lambda: load_artifact(written), "expected a(t most 16 sizes| list of at most 16 items)")
