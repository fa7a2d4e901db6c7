"""Recorded episodes as calls of the policy, for calibration. ``docs/design.md`` section 8 has the formats.

An ``.npz`` with one array for each key of the observation and ``episode_ends [E]``: rows are calls ``[N, To, ...]``, in
order; or, with ``{"frames": true}`` in its ``meta``, frames ``[F, ...]``, from which the windows are cut here.
"""

from __future__ import annotations

import json
import lzma
import os
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .config import ObservationSpec
from .errors import TrajectoryError

Array = npt.NDArray[Any]

ENDS, META = "episode_ends", "meta"

_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    NotImplementedError,
    MemoryError,
)


@dataclass(frozen=True)
class Episode:
    """Consecutive calls between two resets.

    Attributes:
        name: file and number, for messages.
        observations: by key ``[R, *shape]``, one row a call in order, of the specification's dtype, not normalised.
    """

    name: str
    observations: Mapping[str, Array]

    @property
    def calls(self) -> int:
        """R, the number of calls."""
        return len(next(iter(self.observations.values())))


def load_trajectories(
    paths: Sequence[str | os.PathLike[str]], observations: Mapping[str, ObservationSpec], action_steps: int
) -> list[Episode]:
    """Read episodes from files.

    Args:
        paths: ``.npz`` files; never unpickled.
        observations: what one call of the policy takes.
        action_steps: how many actions of a chunk are executed: the frames between two calls.

    Returns:
        The episodes in the order of the files. Rows after the last end of an episode are left out, with a warning.

    Raises:
        TrajectoryError: names the file, what was expected, what it holds, and what to do.
    """
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    if not paths:
        raise TrajectoryError("no trajectory files were given. Name at least one .npz with recorded episodes.")
    return [episode for path in paths for episode in _read(Path(path), observations, action_steps)]


def _read(path: Path, observations: Mapping[str, ObservationSpec], action_steps: int) -> list[Episode]:
    """Episodes of one file."""
    arrays = read_npz(path)
    frames = _meta(path, arrays.pop(META, None))
    if ENDS not in arrays:
        raise TrajectoryError(f"{path}: has no array {ENDS!r}; it has {sorted(arrays)}. Add {ENDS} [E]: {_ENDS_ARE}.")
    ends = _ends(path, arrays.pop(ENDS))
    extra, missing = sorted(set(arrays) - set(observations)), sorted(set(observations) - set(arrays))
    if missing:
        raise TrajectoryError(
            f"{path}: expected an array for each key of the observation, {sorted(observations)}; {missing} are missing,"
            f" and it has {sorted(arrays)}. Record the observations under the keys that the policy was trained with."
        )
    if extra:
        warnings.warn(f"{path}: arrays {extra} are no keys of the observation, and are not used.", stacklevel=4)
    rows = {len(arrays[key]) if arrays[key].ndim else 0 for key in observations}
    if len(rows) != 1:
        lengths = {key: arrays[key].shape for key in observations}
        raise TrajectoryError(f"{path}: observations differ in length: {lengths}. Each needs a row for every call.")
    count = rows.pop()
    if ends[-1] > count:
        raise TrajectoryError(
            f"{path}: {ENDS} says that the last episode ends at row {ends[-1]}, but there are {count} rows: no such"
            " episode is complete. Record it again, or leave the incomplete episode out of episode_ends."
        )
    if ends[-1] < count:
        warnings.warn(f"{path}: {count - ends[-1]} rows after the last end of an episode are not used.", stacklevel=4)
    checked = {key: _checked(path, key, arrays[key], spec, frames) for key, spec in observations.items()}
    episodes = []
    for number, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        part = {key: array[start:end] for key, array in checked.items()}
        if frames:
            part = {key: _windows(array, observations[key].shape[0], action_steps) for key, array in part.items()}
        episodes.append(Episode(f"{path.name}[{number}]", part))
    return episodes


_ENDS_ARE = "for each episode the row after its last, increasing"


def read_npz(path: Path) -> dict[str, Array]:
    """All arrays of an ``.npz``, without unpickling anything.

    Raises:
        TrajectoryError: it is missing, truncated, of another format, or holds Python objects.
    """
    if not path.exists():
        raise TrajectoryError(f"{path}: does not exist. Give the .npz file of a recording.")
    other = _other_format(path)
    if other is not None:
        raise TrajectoryError(
            f"{path}: is {other}, which this version does not read yet. Save the observations as an .npz: one array for"
            f" each key of the observation, and {ENDS} [E]."
        )
    if not path.is_file():
        raise TrajectoryError(f"{path}: expected an .npz file; found something else.")
    try:
        with path.open("rb") as handle:  # numpy leaves it open where it finds no archive
            file = np.load(handle, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise TrajectoryError(
                    f"{path}: expected an .npz with several arrays; found a single one. Use np.savez."
                )
            with file:
                return {name: np.asarray(file[name]) for name in file.files}
    except _UNREADABLE as error:
        raise TrajectoryError(
            f"{path}: cannot be read as .npz ({error}): no such file, truncated, or with Python objects in it, which"
            " are never loaded. Record it again with np.savez and plain arrays."
        ) from error


def _other_format(path: Path) -> str | None:
    name = path.name.lower()
    if name.endswith((".zarr", ".zarr.zip")) or (path / ".zgroup").exists() or (path / "zarr.json").exists():
        return "a zarr store"
    if name.endswith((".hdf5", ".h5")):
        return "an HDF5 file"
    if (path / "meta" / "info.json").exists():
        return "a LeRobot dataset directory"
    return None


def _meta(path: Path, value: Array | None) -> bool:
    """Whether the rows are frames rather than calls."""
    if value is None:
        return False
    text = value.item() if value.ndim == 0 and value.dtype.kind in "SU" else None
    try:
        meta = json.loads(text) if text is not None else None
    except ValueError:
        meta = None
    frames = meta.get("frames", False) if isinstance(meta, dict) else None
    if not isinstance(frames, bool):
        raise TrajectoryError(
            f"{path}: expected {META!r} to be a JSON object in a string array, such as '{{\"frames\": true}}';"
            f" found {str(value)[:80]!r}."
        )
    return frames


def _ends(path: Path, ends: Array) -> list[int]:
    if ends.ndim != 1 or ends.dtype.kind not in "iu":
        raise TrajectoryError(f"{path}: {ENDS} is {ends.dtype}{list(ends.shape)}; expected integers [E], {_ENDS_ARE}.")
    found = [int(end) for end in ends]
    if not found:
        raise TrajectoryError(f"{path}: {ENDS} is empty: no episode is complete. Record at least two whole episodes.")
    if any(b <= a for a, b in zip([0, *found[:-1]], found, strict=True)):
        raise TrajectoryError(f"{path}: {ENDS} is {found[:8]}...; expected {_ENDS_ARE}, the first of them above 0.")
    return found


def _checked(path: Path, key: str, array: Array, spec: ObservationSpec, frames: bool) -> Array:
    """The array in the specification's dtype, of its shape, and finite."""
    shape, what = (spec.shape[1:], "[F, *frame]") if frames else (spec.shape, "[N, *shape]")
    if array.shape[1:] != shape:
        hint = ""
        if array.shape[1:] == spec.shape[1:] and not frames:
            hint = " If its rows are frames, say so: np.savez(..., meta=np.array('{\"frames\": true}'))."
        raise TrajectoryError(
            f"{path}: {key!r} has shape {list(array.shape)};"
            f" expected {what} = [.., {', '.join(map(str, shape))}].{hint}"
        )
    wanted = np.dtype(spec.dtype)
    allowed = "fiu" if wanted.kind == "f" else wanted.kind if wanted.kind not in "iu" else "iu"
    if array.dtype.kind not in allowed:
        raise TrajectoryError(f"{path}: {key!r} has dtype {array.dtype}; expected {wanted}. Convert it with astype.")
    with np.errstate(over="ignore"):
        cast = array.astype(wanted)
    if wanted.kind != "f" and not np.array_equal(cast, array):
        raise TrajectoryError(f"{path}: {key!r} holds numbers that {wanted} cannot; expected values of that dtype.")
    if wanted.kind == "f":
        bad = np.flatnonzero(~np.isfinite(cast.reshape(len(cast), -1)).all(1))
        if len(bad):
            raise TrajectoryError(
                f"{path}: {key!r} holds NaN or infinity in {len(bad)} rows, the first of them row {bad[0]}."
                " Leave the episodes with broken sensors out."
            )
    return cast


def _windows(frames: Array, length: int, stride: int) -> Array:
    """What the policy saw when it was called: the last ``length`` frames, every ``stride`` frames.

    At the start of an episode the first frame stands for those before it, as in Diffusion Policy's environments.
    """
    calls = np.arange(0, len(frames), stride)
    windows: Array = frames[np.maximum(calls[:, None] + np.arange(1 - length, 1), 0)]
    return windows
