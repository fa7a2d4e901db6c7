"""Arrays that orbax saved in a folder (OCDBT), read with tensorstore, in a process of its own.

A chunk unpacks before its size can be compared with anything, and the library is written in C++: so the process that
reads may take so much memory and time, and writes no file. Neither JAX nor orbax is needed, and nothing of a file runs.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from importlib.util import find_spec
from math import prod
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.limits import limit
from ttscompile.errors import CheckpointError

MANIFEST = "manifest.ocdbt"
_FLOATS = ("bfloat16", "float16", "float32", "float64")
_MOST_ARRAYS, _MOST_LINE = 4096, 2**22
_MORE_BYTES, _MORE_SECONDS = 2**30, 30
"""Memory and time of the reader, beyond four times the bytes of the files, and a second for each megabyte."""
_LARGE = 2**24
"""Bytes of an array that is kept in a file without a name, whose pages the system takes back as it needs room."""
_CODE = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from ttscompile.policies.orbax_files import send
send(sys.argv[2])
"""

Array = npt.NDArray[np.float32]


def read_arrays(folder: Path, require: Callable[[list[tuple[int, bool]]], None], room: str) -> dict[str, Array]:
    """All arrays by name, as float32.

    Args:
        folder: with ``manifest.ocdbt``.
        require: is given the size of each array, before memory is taken for any; see ``require_memory_for``.
        room: folder for what is large.

    Raises:
        CheckpointError: no such folder, a damaged one, or no package tensorstore.
    """
    if not (folder / MANIFEST).is_file():
        raise CheckpointError(f"{folder / MANIFEST}: no such file. Copy the checkpoint whole.")
    if find_spec("tensorstore") is None:
        raise CheckpointError(
            f"{folder}: reading it needs the package tensorstore, which is not installed. Install 'ttscompile[openpi]'."
        )
    path = json.dumps([each for each in sys.path if isinstance(each, str)])
    command = [sys.executable, "-I", "-c", _CODE, path, os.fspath(folder.resolve())]
    with Popen(command, stdin=DEVNULL, stdout=PIPE, stderr=DEVNULL, start_new_session=True) as process:  # noqa: S603
        assert process.stdout is not None
        timer = threading.Timer(2 * _seconds(_bytes_of(folder)), process.kill)
        timer.start()
        try:
            shapes: dict[str, list[int]] = _line(process.stdout, folder)["arrays"]
            require([(prod(shape), True) for shape in shapes.values()])
            return {name: _array(process.stdout, folder, shape, room) for name, shape in shapes.items()}
        except EOFError as error:
            status = process.wait()
            how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
            told = f"{folder}: the process that read it ended with {how}: it is damaged, or made to do that"
            raise CheckpointError(f"{told}. Copy it again.") from error
        finally:
            timer.cancel()
            process.kill()


def _line(stream: IO[bytes], folder: Path) -> dict[str, Any]:
    line = stream.readline(_MOST_LINE)
    if not line.endswith(b"\n"):
        raise EOFError
    found: dict[str, Any] = json.loads(line)
    if "error" in found:
        raise CheckpointError(f"{folder}: no arrays of orbax, or damaged ones: {found['error']}. Copy it again.")
    return found


def _array(stream: IO[bytes], folder: Path, shape: list[int], room: str) -> Array:
    _line(stream, folder)
    if 4 * prod(shape) < _LARGE:
        array = np.empty(shape, np.float32)
    else:
        with TemporaryFile(dir=room) as file:
            array = np.memmap(file, np.float32, "w+", shape=tuple(shape))
    flat = array.reshape(-1).view(np.uint8)
    if stream.readinto(flat) != flat.nbytes:  # type: ignore[attr-defined]
        raise EOFError
    return array


def send(folder: str) -> None:
    """Write what a folder holds to the standard output: for a process of its own.

    A line of JSON has the shapes by name; then for each array there is a line, and its numbers, float32.
    """
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the library prints is no answer

    def tell(**line: Any) -> None:
        out.write(json.dumps(line).encode() + b"\n")

    try:
        import tensorstore

        size = _bytes_of(Path(folder))
        limit(_seconds(size), _MORE_BYTES + 4 * size)
        base = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{folder}/"}}
        keys = (key.decode() for key in tensorstore.KvStore.open(base).result().list().result())
        names = sorted(key.removesuffix("/.zarray") for key in keys if key.endswith("/.zarray"))
        if not 0 < len(names) <= _MOST_ARRAYS:
            raise ValueError(f"found {len(names)} arrays in zarr's second format; expected 1 to {_MOST_ARRAYS}")
        specs = ({"driver": "zarr", "kvstore": {**base, "path": f"{name}/"}} for name in names)
        arrays = {name: tensorstore.open(spec, read=True).result() for name, spec in zip(names, specs, strict=True)}
        for name, one in arrays.items():
            chunks: Any = one.chunk_layout.read_chunk.shape
            larger = any(n > max(size, 1) for n, size in zip(chunks, one.shape, strict=True))
            if one.dtype.name not in _FLOATS or larger:
                found = f"{one.dtype.name} {list(one.shape)} in chunks of {list(chunks)}"
                raise ValueError(f"{name:.200} is {found}; expected numbers with a point, in chunks of the array")
        tell(arrays={name: list(one.shape) for name, one in arrays.items()})
        for name, one in arrays.items():
            numbers = np.ascontiguousarray(one.read().result().astype(np.float32, copy=False))
            tell(array=name)
            out.write(numbers.reshape(-1).view(np.uint8).data)
    except Exception as error:  # of whatever kind the library has
        tell(error=f"{type(error).__name__}: {str(error)[:160]}")
    out.flush()
    os._exit(0)  # the library's threads need not be waited for


def _bytes_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def _seconds(size: int) -> int:
    return _MORE_SECONDS + (size >> 20)
