"""A Diffusion Policy replay buffer: a zarr group with ``data/NAME [F, ...]`` and ``meta/episode_ends [E]``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TrajectoryError
from .frames import AS_NPZ, Array, Recording, blocks, bytes_of, one_error, require_files, require_proportion

CODECS = frozenset({"blosc", "bz2", "delta", "gzip", "lz4", "lzma", "shuffle", "zlib", "zstd", "bytes", "crc32c"})
"""Compression that only computes. zarr also knows codecs that unpickle what they read."""


def zarr_recording(path: Path) -> Recording:
    """Open a replay buffer, a directory or zipped.

    Raises:
        TrajectoryError: not one, damaged, or in an encoding that is not read.
    """
    import zarr

    require_files(path)
    hint = "; expected a zarr group with data/NAME [F, ...] and meta/episode_ends [E]"
    with one_error(f"{path}: cannot be read as a replay buffer of Diffusion Policy", hint):
        store: Any = zarr.storage.ZipStore(path, mode="r") if path.is_file() else str(path)
        group = zarr.open_group(store, mode="r")
        data: Any = group["data"]
        ends = group["meta/episode_ends"]
        names = tuple(sorted(name for name, _ in data.arrays()))
    size = bytes_of(path)

    def read(name: str) -> tuple[int, Iterator[Array]]:
        array = data[name]
        _require_plain(path, array, size)
        return array.shape[0], _blocks(path, array)

    _require_plain(path, ends, size)
    return Recording(names, read, np.concatenate(list(_blocks(path, ends))))


def _require_plain(path: Path, array: Any, size: int) -> None:
    """Raise unless nothing but numbers and compression is in an array, and not more than the files can hold."""
    kind, codecs = np.dtype(array.dtype).kind, _codecs(array.metadata)
    if kind not in "biuf" or not codecs <= CODECS or not array.shape:
        what = f"compressed by {', '.join(sorted(codecs - CODECS))}" if kind in "biuf" else f"of dtype {array.dtype}"
        told = f"{what if array.shape else 'a single value'}; expected rows of numbers, compressed by one of"
        told += f" {', '.join(sorted(CODECS))}. Write it again with another compressor, or {AS_NPZ}"
        raise TrajectoryError(f"{path}: {array.path!r} is {told}")
    require_proportion(path, math.prod(array.shape) * array.dtype.itemsize, size)


def _blocks(path: Path, array: Any) -> Iterator[Array]:
    with one_error(f"{path}: {array.path!r} is damaged", ". Copy it again"):  # truncated chunks and the like
        yield from blocks(array)


def _codecs(metadata: Any) -> set[str]:
    """Names of whatever turns stored bytes into numbers, of either version of the format."""
    if metadata.zarr_format == 2:
        return {str(one.codec_id) for one in (*(metadata.filters or ()), metadata.compressor) if one is not None}
    return {str(one.to_dict()["name"]).removeprefix("numcodecs.") for one in metadata.codecs}
