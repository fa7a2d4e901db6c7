"""Frames of recorded episodes, whatever file they come from, as the observations of a policy."""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.coercion import Array, Arrays
from ..core.spec import Instruction, ObservationSpec
from ..core.tokenizer import TASK, ReadTokenizer, padded
from ..errors import TrajectoryError

MAX_RATIO, FREE_BYTES = 200, 256 * 2**20
"""Arrays may take so many times the bytes of their file, or this much; what takes more is a bomb. Deflate reaches 1000
on zeros; recorded images 10."""
BLOCK_BYTES = 32 * 2**20
"""Rows are read so many bytes at a time, or one chunk."""

AS_NPZ = "save the observations as an .npz."
"""What can be done about any recording that is not read."""


@dataclass(frozen=True)
class Frames:
    """What a file holds; arrays are read when they are asked for.

    Attributes:
        read: the array ``[F, ...]`` of a name.
        ends: for each episode the frame after its last, increasing.
    """

    names: Sequence[str]
    read: Callable[[str], Array]
    ends: Array


@dataclass(frozen=True)
class Recording:
    """A data set that is open, in the process that reads it.

    Attributes:
        read: the rows of an array by its name, F, and blocks ``[n, ...]`` of them as they are stored.
        ends: for each episode the frame after its last, increasing.
        order: ``[F]`` which stored row is which frame, if they are not in order.
        notes: what was found odd so far, to be told as warnings.
    """

    names: Sequence[str]
    read: Callable[[str], tuple[int, Iterator[Array]]]
    ends: Array
    order: Array | None = None
    notes: list[str] = field(default_factory=list)


def frames_of_calls(frames: Frames, stride: int) -> Frames:
    """Those in which calls begin, which are all that a policy of one frame sees: no other is made floats."""
    starts = np.append(0, frames.ends[:-1])
    rows = [np.arange(start, end, stride) for start, end in zip(starts, frames.ends, strict=True)]
    chosen, ends = np.concatenate(rows), np.cumsum([len(each) for each in rows])
    return Frames(frames.names, lambda name: frames.read(name)[chosen], ends)


def observation_frames(
    path: Path, frames: Frames, observations: Mapping[str, ObservationSpec], sources: Mapping[str, Sequence[str]]
) -> dict[str, Array]:
    """The frames of each key of the observation.

    Args:
        sources: by key, the arrays that it is made of where they are called otherwise: flattened frame by frame and
            joined; ``NAME:N`` are the first N numbers of one.

    Returns:
        By key ``[F, *frame]``. Images ``[F, H, W, C]`` become ``[F, C, H, W]``, divided by 255, where the policy takes
        them so: what the original data sets do.
    """
    found = {}
    for key, spec in observations.items():
        parts = sources.get(key, (key,))
        arrays = [_part(path, frames, key, part, spec.image) for part in parts]
        if len(arrays) == 1 and ":" not in parts[0]:
            found[key] = _as_image(arrays[0], spec.one_frame)
            continue
        if len({array.shape[:1] for array in arrays}) != 1:
            shapes = {part: list(array.shape) for part, array in zip(parts, arrays, strict=True)}
            raise TrajectoryError(f"{path}: what the observation {key!r} is made of differs in length: {shapes}.")
        found[key] = np.concatenate([_flat(path, *each) for each in zip(parts, arrays, strict=True)], axis=1)
    return found


def _part(path: Path, frames: Frames, key: str, part: str, image: bool) -> Array:
    name, colon, count = part.partition(":")
    if name not in frames.names:
        words = "language" in key and TASK in frames.names
        own = "An artifact that was compiled with --encoders DIR makes tokens of its instructions"
        remedy = f" {own}; so does --observation task=DIR, with DIR/tokenizer.json." if words else ""
        if image:
            remedy = f" A vision-language-action model can do without it: convert --without-camera {key}."
        raise TrajectoryError(
            f"{path}: has no array {name!r} for the observation {key!r}; it has {few(frames.names)}.{remedy} Say what"
            f" the observation is made of, in order: --observation {key}=NAME,NAME:N (NAME:N are its first N), or"
            f' observation={{"{key}": ["NAME", "NAME:N"]}}.'
        )
    array = frames.read(name)
    if not colon:
        return array
    flat = _flat(path, name, array)
    if not count.isdecimal() or not 0 < int(count) <= flat.shape[1]:
        told = f"{path}: {part!r} for the observation {key!r}: expected after the colon how many of the"
        raise TrajectoryError(f"{told} {flat.shape[1]} numbers of {name!r} are taken.")
    return flat[:, : int(count)]


def few(names: Sequence[str]) -> str:
    """The first names, and how many there are: an archive of something else may have thousands."""
    return ", ".join(names[:8]) + f", .. ({len(names)} in all)" * (len(names) > 8)


def _flat(path: Path, name: str, array: Array) -> Array:
    """Frames as ``[F, numbers]``."""
    if not array.ndim or not array.size:
        raise TrajectoryError(f"{path}: {name!r} is {list(array.shape)}; expected frames [F, ...] that are not empty.")
    return array.reshape(len(array), -1)


def _as_image(array: Array, spec: ObservationSpec) -> Array:
    """Channels first and in 0..1 where the policy takes images so, and the recording has them last and in 0..255."""
    frame = spec.shape
    if array.ndim != 4 or len(frame) != 3 or array.shape[1:] == frame or array.shape[-1] != frame[0]:
        return array
    if array.shape[1:3] != frame[1:] and (spec.fit is None or array.shape[1] == frame[0]):
        return array
    whole = array.dtype.kind in "iu" or bool(array.size and array.max() > 1.5)
    turned = np.moveaxis(array, -1, 1)
    return turned.astype(np.float32) / 255 if whole else turned


def require_proportion(path: Path, total: int, size: int) -> None:
    """Raise TrajectoryError if so many bytes of arrays are out of proportion to the bytes of their file."""
    if total > max(FREE_BYTES, MAX_RATIO * size):
        raise TrajectoryError(
            f"{path}: expected arrays in proportion to a file of {size} bytes, at most {MAX_RATIO} times as much; it"
            f" says {total} bytes. Record it again."
        )


def blocks(array: Any) -> Iterator[Array]:
    """The rows of an array ``[F, ...]`` of zarr or h5py: about ``BLOCK_BYTES`` at once, and whole chunks of rows."""
    chunk = max(1, array.chunks[0]) if array.chunks else 1
    whole = BLOCK_BYTES // max(1, math.prod(array.shape[1:]) * array.dtype.itemsize * chunk)
    step = max(1, whole) * chunk
    for start in range(0, max(1, array.shape[0]), step):
        yield np.asarray(array[start : start + step])


def bytes_of(path: Path) -> int:
    """Bytes of a file, or of all files in a directory."""
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size


def worth_of(path: Path) -> int:
    """The same, where a byte of a video counts as ten: it holds as many numbers, and takes as long to decode."""
    videos = path / "videos"
    return bytes_of(path) + (9 * bytes_of(videos) if videos.is_dir() else 0)


def require_files(path: Path) -> None:
    """Raise unless a file, or all in a directory, are files of bytes: reading a pipe or ``/dev/zero`` does not end.

    Links to files are followed, which is how caches of downloads keep them; links to directories are not.
    """
    for folder, names, files in os.walk(path) if path.is_dir() else [("", [], [os.fspath(path)])]:
        wrong = [name for name in names if Path(folder, name).is_symlink()]
        for name in files:
            file = Path(folder, name)
            system = file.is_symlink() and file.resolve().parts[1:2] in (("proc",), ("sys",), ("dev",))
            if system or not file.is_file():
                wrong.append(name)
        if wrong:
            raise TrajectoryError(
                f"{path}: {Path(folder, wrong[0])} is a link to a directory or to nothing, a pipe or a device;"
                " expected files and directories. Copy the recording without it."
            )


@contextmanager
def one_error(what: str, hint: str = "") -> Iterator[None]:
    """Within the block every error is a ``TrajectoryError``: libraries that decode raise whatever their parts raise.

    It says what went wrong, the error's own words in brackets, and a hint of what to do. A package that is not
    installed is told by ``sandbox``.
    """
    try:
        yield
    except (TrajectoryError, ModuleNotFoundError):
        raise
    except Exception as error:
        raise TrajectoryError(f"{what} ({type(error).__name__}: {str(error)[:160]}){hint}.") from error


def instruction_rows(
    path: Path,
    held: Frames,
    instruction: Instruction,
    observations: Mapping[str, ObservationSpec],
    tokenizer: ReadTokenizer,
    others: Arrays,
) -> dict[str, Array]:
    """Tokens and mask of every row, from its text.

    Args:
        held: what it holds: ``task``, texts ``[F]`` or their bytes ``[F, L]``.
        tokenizer: gives the policy's tokenizer.
        others: by key the other observations, ``[F, ...]``, of which the instruction may hold the state.

    Returns:
        By key int64 ``[F, length]`` and bool ``[F, length]``.
    """
    if TASK not in held.names:
        found = f"{path}: has no array {TASK!r}; it has {few(held.names)}. Expected the text of each row, as LeRobot's"
        raise TrajectoryError(f"{found} data sets have it. Leave the tokenizer out, and record tokens.")
    texts = held.read(TASK)
    if texts.dtype == np.uint8 and texts.ndim == 2 and texts.shape[1]:
        texts = np.ascontiguousarray(texts).view(f"S{texts.shape[1]}")[:, 0]
    if texts.dtype.kind not in "US" or texts.ndim != 1:
        raise TrajectoryError(f"{path}: {TASK!r} is {texts.dtype}{list(texts.shape)}; expected texts [F].")
    made, length = tokenizer(TrajectoryError), observations[instruction.tokens].shape[-1]
    lines = [each.decode(errors="replace") if isinstance(each, bytes) else each for each in texts.tolist()]
    states = [""] * len(lines)
    if instruction.state is not None:
        rows, numbers = _flat(path, instruction.state.key, others[instruction.state.key]), len(instruction.state.first)
        if rows.shape != (len(lines), numbers):
            expected = f"expected {[len(lines), numbers]}, a state for each text"
            raise TrajectoryError(f"{path}: {instruction.state.key!r} is {list(rows.shape)}; {expected}.")
        states = list(map(instruction.state, rows.astype(np.float32)))
    pairs = list(zip(lines, states, strict=True))
    known = {(text, state): made.of_task(text, instruction, length, state) for text, state in dict.fromkeys(pairs)}
    tokens, mask = padded([known[one] for one in pairs], length)
    return {instruction.tokens: tokens, instruction.mask: mask}
