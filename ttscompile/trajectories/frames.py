"""Frames of recorded episodes, whatever file they come from, as the observations of a policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..config import ObservationSpec
from ..errors import TrajectoryError

Array = npt.NDArray[Any]

MAX_RATIO, FREE_BYTES = 200, 256 * 2**20
"""Arrays may take so many times the bytes of their file, or this much; what takes more is a bomb. Deflate reaches 1000
on zeros; recorded images 10."""


@dataclass(frozen=True)
class Frames:
    """What a file holds; arrays are read when they are asked for.

    Attributes:
        names: of the arrays.
        read: the array ``[F, ...]`` of a name.
        ends: for each episode the frame after its last, increasing.
    """

    names: Sequence[str]
    read: Callable[[str], Array]
    ends: Array


def observation_frames(
    path: Path, frames: Frames, observations: Mapping[str, ObservationSpec], sources: Mapping[str, Sequence[str]]
) -> dict[str, Array]:
    """The frames of each key of the observation.

    Args:
        path: for messages.
        frames: of the file.
        observations: of the policy.
        sources: by key, the arrays that it is made of where they are called otherwise: flattened frame by frame and
            joined; ``NAME:N`` are the first N numbers of one.

    Returns:
        By key ``[F, *frame]``. Images ``[F, H, W, C]`` become ``[F, C, H, W]``, divided by 255, where the policy takes
        them so: what the original data sets do.

    Raises:
        TrajectoryError: an array is missing; names those that there are.
    """
    found = {}
    for key, spec in observations.items():
        parts = sources.get(key, (key,))
        arrays = [_part(path, frames, key, part) for part in parts]
        if len(arrays) == 1 and ":" not in parts[0]:
            found[key] = _as_image(arrays[0], spec.shape[1:] if spec.frames is not None else spec.shape)
        else:
            found[key] = np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
    return found


def _part(path: Path, frames: Frames, key: str, part: str) -> Array:
    """One of the arrays that a key is made of."""
    name, colon, count = part.partition(":")
    if name not in frames.names:
        raise TrajectoryError(
            f"{path}: has no array {name!r} for the observation {key!r}; it has {', '.join(frames.names)}. Say what the"
            f" observation is made of, in order: --observation {key}=NAME,NAME:N (NAME:N are its first N numbers), or"
            f' observation={{"{key}": ["NAME", "NAME:N"]}}.'
        )
    array = frames.read(name)
    if not colon:
        return array
    flat = array.reshape(len(array), -1)
    if not count.isdecimal() or not 0 < int(count) <= flat.shape[1]:
        raise TrajectoryError(
            f"{path}: {part!r} for the observation {key!r}: expected after the colon how many of the"
            f" {flat.shape[1]} numbers of {name!r} are taken."
        )
    return flat[:, : int(count)]


def _as_image(array: Array, frame: tuple[int, ...]) -> Array:
    """Channels first and in 0..1 where the policy takes images so, and the recording has them last and in 0..255."""
    if array.ndim != 4 or len(frame) != 3 or array.shape[1:] == frame:
        return array
    if array.shape[1:] != (*frame[1:], frame[0]):
        return array
    whole = array.dtype.kind in "iu" or bool(array.size and array.max() > 1.5)
    turned = np.moveaxis(array, -1, 1)
    return turned.astype(np.float32) / 255 if whole else turned


def require_proportion(path: Path, total: int, size: int) -> None:
    """Raise if arrays are out of proportion to their file.

    Args:
        path: for messages.
        total: bytes of the arrays.
        size: bytes of the file.

    Raises:
        TrajectoryError: they are.
    """
    if total > max(FREE_BYTES, MAX_RATIO * size):
        raise TrajectoryError(
            f"{path}: expected arrays in proportion to a file of {size} bytes, at most {MAX_RATIO} times as much; it"
            f" says {total} bytes. Record it again."
        )


def require_package(path: Path, package: str) -> TrajectoryError:
    """The error of a package that is not installed."""
    return TrajectoryError(
        f"{path}: reading this takes the package {package!r}, which is not installed. Install 'ttscompile[recordings]',"
        " or save the observations as an .npz."
    )
