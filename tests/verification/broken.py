"""Break an artifact so that its bytes still fit each other: what changed is what it computes."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.artifact import tensors
from ttscompile.artifact.codec import encode, identities
from ttscompile.artifact.files import describe
from ttscompile.artifact.load import read_manifest
from ttscompile.artifact.manifest import MANIFEST
from ttscompile.artifact.short import SHORT, parts


def edit_manifest(directory: Path, **changes: Any) -> None:
    """Change fields of the manifest; hashes of files, identities and checksum are made anew."""
    manifest = replace(read_manifest(directory), **changes)
    manifest = replace(manifest, files={name: describe(directory / name) for name in manifest.files})
    identity, model_identity = identities(manifest)
    manifest = replace(manifest, identity=identity, model_identity=model_identity)
    (directory / MANIFEST).write_bytes(encode(manifest))


@contextmanager
def edited(directory: Path, store: str) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """The arrays of one of the artifact's stores, to be changed in the block; every tensor stays where it lies."""
    path = directory / getattr(read_manifest(directory).stores, store)
    places = tensors.entries_of(path)
    arrays = {name: np.array(array) for name, array in tensors.read(path, short=True).items()}
    yield arrays
    content = bytearray(path.read_bytes())
    for name, place in places.items():
        array = arrays[name]
        short = (short.tobytes() for _, short in parts(array, place.code))
        stored = b"".join(short) if place.code in SHORT else array.tobytes()
        assert len(stored) == place.length, "the ONNX graphs would read other weights"
        content[place.offset : place.offset + place.length] = stored
    path.write_bytes(content)
    edit_manifest(directory)


def exchange_names(directory: Path, one: str, other: str) -> None:
    """Exchange the names of two weights in the header of their file; the data stay where they are."""
    path = directory / read_manifest(directory).stores.weights
    content = path.read_bytes()
    size = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:size])
    header[one], header[other] = header[other], header[one]
    made = json.dumps(header, separators=(",", ":")).encode()
    assert len(made) <= size - 8
    path.write_bytes(content[:8] + made.ljust(size - 8) + content[size:])
    edit_manifest(directory)
