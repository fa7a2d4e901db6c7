"""A robomimic data set: an HDF5 file with ``data/DEMO/obs/NAME [F, ...]``, a group for each demonstration."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TrajectoryError
from .frames import Array, Frames, require_package, require_proportion


def hdf5_frames(path: Path) -> Frames:
    """Open a data set.

    Raises:
        TrajectoryError: not one, damaged, or with data outside of the file.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise require_package(path, "h5py") from error
    try:
        with h5py.File(path, "r") as file:
            demos = sorted(_inside(path, file, "data"), key=_number)
            groups = [_inside(path, file, f"data/{demo}/obs") for demo in demos]
            lengths = [_length(path, group) for group in groups]
            names = sorted(set.intersection(*(set(group) for group in groups)))
    except TrajectoryError:
        raise
    except Exception as error:  # h5py raises KeyError, OSError, ValueError and RuntimeError
        raise TrajectoryError(
            f"{path}: cannot be read as a data set of robomimic ({type(error).__name__}: {str(error)[:160]});"
            " expected an HDF5 file with data/DEMO/obs/NAME [F, ...]."
        ) from error
    return Frames(names, lambda name: _read(path, demos, name), np.cumsum(lengths))


def _read(path: Path, demos: list[str], name: str) -> Array:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            arrays = [_inside(path, file, f"data/{demo}/obs/{name}") for demo in demos]
            for array in arrays:
                _require_plain(path, array)
            require_proportion(path, sum(array.nbytes for array in arrays), path.stat().st_size)
            return np.concatenate([array[:] for array in arrays])
    except TrajectoryError:
        raise
    except Exception as error:
        raise TrajectoryError(f"{path}: {name!r} is damaged ({type(error).__name__}: {str(error)[:160]}).") from error


def _inside(path: Path, file: Any, name: str) -> Any:
    """A group or an array, no part of whose path is a link to another file."""
    import h5py

    walked = file
    for part in name.split("/"):
        link = walked.get(part, getlink=True)
        if link is None or isinstance(link, h5py.ExternalLink):
            what = "is missing" if link is None else "is a link to another file"
            raise TrajectoryError(f"{path}: {name!r} {what}; expected a data set of robomimic, data/DEMO/obs/NAME.")
        walked = walked[part]
    return walked


def _length(path: Path, group: Any) -> int:
    lengths = {len(_inside(path, group, name)) for name in group}
    if len(lengths) != 1:
        raise TrajectoryError(f"{path}: arrays of {group.name} differ in length: {sorted(lengths)}.")
    return int(lengths.pop())


def _require_plain(path: Path, array: Any) -> None:
    """Raise unless an array is numbers that are in the file itself."""
    if np.dtype(array.dtype).kind not in "biuf" or array.is_virtual or array.external:
        where = "" if np.dtype(array.dtype).kind not in "biuf" else ", with its data in other files"
        raise TrajectoryError(f"{path}: {array.name!r} is {array.dtype}{where}; expected numbers in the file itself.")


def _number(demo: str) -> tuple[int, str]:
    """Order of ``demo_2`` and ``demo_10``."""
    found = re.search(r"\d+$", demo)
    return (int(found.group()) if found else 0, demo)
