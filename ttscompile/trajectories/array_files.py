"""Recordings that are arrays, each by its name: replay buffers of Diffusion Policy, and data sets of robomimic.

The former are a zarr group with ``data/NAME [F, ...]`` and ``meta/episode_ends [E]``, the latter an HDF5 file with
``data/DEMO/obs/NAME [F, ...]``, a group for each demonstration.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..core.coercion import Array
from ..errors import TrajectoryError
from .frames import AS_NPZ, Recording, blocks, bytes_of, one_error, require_files, require_proportion

CODECS = frozenset({"blosc", "bz2", "delta", "gzip", "lz4", "lzma", "shuffle", "zlib", "zstd", "bytes", "crc32c"})
"""Compression that only computes. zarr also knows codecs that unpickle what they read."""
_READABLE = f"compressed by one of {', '.join(sorted(CODECS))}. Write it again with such a compressor, or {AS_NPZ}"


def zarr_recording(path: Path) -> Recording:
    """Open a replay buffer, a directory or zipped."""
    import zarr

    require_files(path)
    hint = f"; expected a zarr group with data/NAME [F, ...] and meta/episode_ends [E], {_READABLE[:-1]}"
    with one_error(f"{path}: cannot be read as a replay buffer of Diffusion Policy", hint):
        store: Any = zarr.storage.ZipStore(path, mode="r") if path.is_file() else str(path)
        group = zarr.open_group(store, mode="r")
        if "data/robot0_demo_start_pose" in group:
            told = "a data set of UMI has the robot's poses, and its policies observe them relative to the newest one"
            raise TrajectoryError(f"{path}: {told}. So {AS_NPZ}")
        data: Any = group["data"]
        ends = group["meta/episode_ends"]
        names = tuple(sorted(name for name, _ in data.arrays()))
    size, notes = bytes_of(path), list[str]()

    def read(name: str) -> tuple[int, Iterator[Array]]:
        array = data[name]
        _require_plain_zarr(path, array, size)
        if array.shards is None and (lacking := array.nchunks - array.nchunks_initialized):
            told = f"{path}: {lacking} of {array.nchunks} chunks of {name!r} are not there, and read as"
            notes.append(f"{told} {array.fill_value}. If that is not what was recorded, copy it again.")
        return array.shape[0], _zarr_blocks(path, array)

    _require_plain_zarr(path, ends, size)
    return Recording(names, read, np.concatenate(list(_zarr_blocks(path, ends))), notes=notes)


def _require_plain_zarr(path: Path, array: Any, size: int) -> None:
    """Raise unless nothing but numbers and compression is in an array, and not more than the files can hold."""
    kind, codecs = np.dtype(array.dtype).kind, _codecs(array.metadata)
    if kind not in "biuf" or not codecs <= CODECS or not array.shape:
        what = f"compressed by {', '.join(sorted(codecs - CODECS))}" if kind in "biuf" else f"of dtype {array.dtype}"
        told = f"{what if array.shape else 'a single value'}; expected rows of numbers, {_READABLE}"
        raise TrajectoryError(f"{path}: {array.path!r} is {told}")
    require_proportion(path, math.prod(array.shape) * array.dtype.itemsize, size)


def _zarr_blocks(path: Path, array: Any) -> Iterator[Array]:
    with one_error(f"{path}: {array.path!r} is damaged", ". Copy it again"):  # truncated chunks and the like
        yield from blocks(array)


def _codecs(metadata: Any) -> set[str]:
    """Names of whatever turns stored bytes into numbers, of either version of the format."""
    if metadata.zarr_format == 2:
        return {str(one.codec_id) for one in (*(metadata.filters or ()), metadata.compressor) if one is not None}
    return {str(one.to_dict()["name"]).removeprefix("numcodecs.") for one in metadata.codecs}


FILTERS = frozenset({"gzip", "lzf", "shuffle", "fletcher32"})
"""Compression that h5py has itself; others are libraries of their own."""


def hdf5_recording(path: Path) -> Recording:
    """Open a data set, of which nothing may be outside of the file."""
    import h5py

    require_files(path)
    hint = "; expected an HDF5 file with data/DEMO/obs/NAME [F, ...]"
    with one_error(f"{path}: cannot be read as a data set of robomimic", hint), h5py.File(path, "r") as file:
        demos = sorted(_group(path, file, "data"), key=lambda demo: (int((re.search(r"\d+$", demo) or "0")[0]), demo))
        groups = [_group(path, file, f"data/{demo}/obs") for demo in demos]
        lengths = [_length(path, group) for group in groups]
        names = sorted(set.intersection(*(set(group) for group in groups)))
    total = sum(lengths)
    ends = np.cumsum(lengths) if total < 2**62 else np.zeros(0, np.int64)
    return Recording(names, lambda name: (total, _hdf5_blocks(path, demos, name)), ends)


def _hdf5_blocks(path: Path, demos: list[str], name: str) -> Iterator[Array]:
    """Rows of all demonstrations; sizes are compared with the file's before the first is read."""
    import h5py

    with one_error(f"{path}: {name!r} is damaged"), h5py.File(path, "r") as file:
        arrays = [_inside(path, file, f"data/{demo}/obs/{name}") for demo in demos]
        for array in arrays:
            _require_plain_hdf5(path, array)
        require_proportion(path, sum(math.prod(a.shape) * a.dtype.itemsize for a in arrays), path.stat().st_size)
        for array in arrays:
            yield from blocks(array)


def _inside(path: Path, file: Any, name: str) -> Any:
    """A group or an array, no part of whose path is a link: a symbolic one may lead through one to another file."""
    import h5py

    walked = file
    for part in name.split("/"):
        link = walked.get(part, getlink=True)
        if not isinstance(link, h5py.HardLink):
            what = "is missing" if link is None else "is a link, maybe to another file"
            raise TrajectoryError(f"{path}: {name!r} {what}; expected a data set of robomimic, data/DEMO/obs/NAME.")
        walked = walked[part]
    return walked


def _group(path: Path, file: Any, name: str) -> Any:
    """A group; an array in its place could have rows without end."""
    found = _inside(path, file, name)
    if not hasattr(found, "keys"):
        raise TrajectoryError(f"{path}: {name!r} is an array; expected a group of a data set of robomimic.")
    return found


def _length(path: Path, group: Any) -> int:
    lengths = {len(_inside(path, group, name)) for name in group}
    if len(lengths) != 1 or 0 in lengths:
        raise TrajectoryError(f"{path}: arrays of {group.name} differ in length, or are empty: {sorted(lengths)}.")
    return int(lengths.pop())


def _require_plain_hdf5(path: Path, array: Any) -> None:
    """Raise unless an array is numbers that are in the file itself, compressed by what is known."""
    numbers = np.dtype(array.dtype).kind in "biuf"
    if not numbers or array.is_virtual or array.external:
        where = ", with its data in other files" if numbers else ""
        raise TrajectoryError(f"{path}: {array.name!r} is {array.dtype}{where}; expected numbers in the file itself.")
    if unknown := sorted({str(name) for name in array._filters} - FILTERS):
        told = f"compressed by {', '.join(unknown)}; expected {', '.join(sorted(FILTERS))}"
        raise TrajectoryError(f"{path}: {array.name!r} is {told}. Write it again (h5repack), or {AS_NPZ}")
