"""Data sets read in a process of its own, with limits that the libraries which decode them do not have.

A chunk of a hundred kilobytes unpacks to gigabytes before its size can be compared with anything, and what is written
in C may crash. The reader may take so much memory and time, and writes no file. It sends arrays in blocks of rows, each
a line of JSON and its bytes, so that its memory does not grow with the arrays.
"""

import importlib
import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO

import numpy as np

from ..core.coercion import Array
from ..core.limits import limit
from ..errors import TrajectoryError
from .array_files import hdf5_recording, zarr_recording
from .frames import AS_NPZ, BLOCK_BYTES, Frames, Recording, bytes_of, one_error, require_proportion, worth_of
from .lerobot_dataset import lerobot_recording

MORE_BYTES, MORE_SECONDS = 2**30, 4
"""Memory and processor time of a reader beyond what its imports take; more for large files."""
FORMATS = {"hdf5": hdf5_recording, "lerobot": lerobot_recording, "zarr": zarr_recording}
_OPENED = [f"PIL.{name}ImagePlugin" for name in ("Bmp", "Gif", "Jpeg", "Ppm", "Png")]
"""What Pillow imports when an image is opened, whatever formats are allowed."""
IMPORTS = {"hdf5": ["h5py"], "lerobot": ["pyarrow.parquet", "pyarrow.compute", *_OPENED], "zarr": ["zarr"]}
"""What a reader imports before it is limited."""
_CODE = """
import json, sys
request = json.loads(sys.stdin.buffer.readline())
sys.path[:] = request["sys_path"]
from ttscompile.trajectories.sandbox import serve_alone
serve_alone(request)
"""


def sandboxed_frames(path: Path, kind: str, wanted: Sequence[str], **how: int) -> Frames:
    """The wanted arrays of a data set that is one of ``FORMATS``, opened so; those that it lacks are left out."""
    arrays, own = dict[str, Array](), dict[str, Array]()
    with reader({"path": os.fsdecode(path), "kind": kind, "wanted": list(wanted), "how": how}) as stream:
        names = _line(stream)["names"]
        while "end" not in (line := _line(stream)):
            array = _array(stream, line)
            if "own" in line:
                own[line["own"]] = array
            else:
                arrays[line["array"]] = array[own["order"]] if "order" in own else array
        for note in line["notes"]:
            warnings.warn(note, stacklevel=2)
    return Frames(names, arrays.__getitem__, own["ends"])


@contextmanager
def reader(request: Mapping[str, Any]) -> Iterator[IO[bytes]]:
    """The output of a process that answers a request."""
    told = {**request, "sys_path": [each for each in sys.path if isinstance(each, str)]}
    command = [sys.executable, "-I", "-c", _CODE]
    env = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}  # the other one takes a gigabyte when it begins
    with Popen(  # noqa: S603 -- this python and the code above
        command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, env=env, start_new_session=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        seconds = 60 + 10 * _seconds(worth_of(Path(request["path"])))
        timer = threading.Timer(seconds, process.kill)  # waits for something that does not come
        timer.start()
        try:
            process.stdin.write(json.dumps(told).encode() + b"\n")
            process.stdin.close()
            yield process.stdout
        except (EOFError, BrokenPipeError) as error:
            process.kill()  # it may have sent nonsense, and be alive
            raise _ended(request["path"], process.wait()) from error
        finally:
            timer.cancel()
            process.kill()


def _ended(path: str, status: int) -> TrajectoryError:
    how = f"with exit status {status}"
    if status < 0:
        name = signal.Signals(-status).name
        how = f"by {name}" + (", at its limit of time or memory" if name in ("SIGXCPU", "SIGKILL") else "")
    told = f"{path}: the process that read it ended {how}: it is damaged, or made to do that. Copy it again, or"
    return TrajectoryError(f"{told} {AS_NPZ}")


def _array(stream: IO[bytes], line: Mapping[str, Any]) -> Array:
    shape, dtype = tuple(line["shape"]), np.dtype(line["dtype"])
    large = dtype.itemsize * int(np.prod(shape, dtype=object)) > BLOCK_BYTES
    with TemporaryFile() as file:  # which stays as long as the array: pictures of hundreds of episodes are on disk
        array = np.memmap(file, dtype, "w+", shape=shape) if large else np.empty(shape, dtype)
    done = 0
    while done < len(array):
        head = _line(stream)
        part = array[done : done + head["rows"]]
        flat = part.reshape(-1).view(np.uint8)
        if stream.readinto(flat) != flat.nbytes:  # type: ignore[attr-defined]
            raise EOFError
        done += head["rows"]
    return array


def _line(stream: IO[bytes]) -> dict[str, Any]:
    """The next line of an answer. Raises EOFError: it ends too early."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    found: dict[str, Any] = json.loads(line)
    if "error" in found:
        raise TrajectoryError(found["error"])
    return found


def serve_alone(request: Mapping[str, Any]) -> None:
    """Answer a request on the standard output, and do nothing else: for a process of its own."""
    sys.dont_write_bytecode = True
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    path = Path(request["path"])
    for package in [*IMPORTS[request["kind"]], *(["av"] if (path / "videos").is_dir() else [])]:
        with suppress(ModuleNotFoundError):  # the reader says so
            importlib.import_module(package)
    limit(1 + _seconds(worth_of(path)), MORE_BYTES + 4 * bytes_of(path))  # as files are, not as they declare
    serve(request, out)
    out.flush()
    os._exit(0)  # threads of a library need not be waited for


def serve(request: Mapping[str, Any], out: BinaryIO) -> None:
    """Answer a request on a stream."""
    path = Path(request["path"])
    try:
        with one_error(f"{path}: is damaged, or no recording of its format", ". Copy it again"):
            recording: Recording = FORMATS[request["kind"]](path, **request["how"])
            _send(out, names=list(recording.names))
            for name, own in {"ends": recording.ends, "order": recording.order}.items():
                if own is not None:
                    _send_array(path, out, {"own": name}, len(own), iter([own]))
            for name in request["wanted"]:
                if name in recording.names:
                    _send_array(path, out, {"array": name}, *recording.read(name))
            _send(out, end=True, notes=recording.notes)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        told = f"{path}: reading this takes the package {package!r}, which is not installed"
        extra = "videos" if package == "av" else "recordings"
        _send(out, error=f"{told}. Install 'ttscompile[{extra}]', or {AS_NPZ}")
    except TrajectoryError as error:
        _send(out, error=str(error))


def _send_array(path: Path, out: BinaryIO, head: Mapping[str, str], rows: int, blocks: Iterator[Array]) -> None:
    first: Array | None = None
    (name,) = head.values()
    for block in blocks:
        if first is None:
            first = block[:0].copy()
            row = first.dtype.itemsize * int(np.prod(first.shape[1:], dtype=object))
            require_proportion(path, row * rows, worth_of(path))
            if first.dtype.kind not in "biuf":
                raise TrajectoryError(f"{path}: {name!r} is {first.dtype}; expected numbers.")
            _send(out, **head, dtype=first.dtype.str, shape=[rows, *first.shape[1:]])
        if block.shape[1:] != first.shape[1:] or block.dtype != first.dtype or len(block) > rows:
            raise TrajectoryError(
                f"{path}: frames of {name!r} are {first.dtype}{list(first.shape[1:])} and {block.dtype}"
                f"{list(block.shape[1:])}, or more than {rows} are left; expected one shape, and a row for each frame."
            )
        if len(block):
            rows -= len(block)
            _send(out, rows=len(block))
            out.write(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)
    if rows or first is None:
        raise TrajectoryError(f"{path}: {name!r} lacks {rows} frames; expected a row for each.")


def _send(out: BinaryIO, **line: Any) -> None:
    out.write(json.dumps(line).encode() + b"\n")


def _seconds(size: int) -> int:
    """Processor time for files of so many bytes: a megabyte a second, which is slow for every codec."""
    return MORE_SECONDS + (size >> 20)
