"""Data sets as users have them, written with the libraries that write them."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import zarr
from PIL import Image

from ttscompile.core.spec import ObservationSpec
from ttscompile.trajectories import apart

LOW = {"obs": ObservationSpec((2, 8))}
IMAGES = {"image": ObservationSpec((2, 3, 5, 4)), "state": ObservationSpec((2, 5))}
SOURCES = {"obs": ("keypoint", "state:2")}
ENDS = [5, 9]


@contextmanager
def read_here(request: Mapping[str, Any]) -> Iterator[BinaryIO]:
    """What the process that reads data sets does, without one: it takes half a second."""
    out = io.BytesIO()
    apart.serve(request, out)
    out.seek(0)
    yield out


def arrays() -> dict[str, np.ndarray]:
    draw = np.random.default_rng(0)
    return {
        "keypoint": draw.standard_normal((9, 3, 2)).astype(np.float32),
        "state": draw.standard_normal((9, 5)).astype(np.float32),
        "img": draw.integers(0, 256, (9, 5, 4, 3), np.uint8),
    }


def as_npz(path: Path) -> Path:
    meta = np.array('{"frames": true}')
    held = arrays()
    np.savez(path / "it.npz", keypoint=held["keypoint"], state=held["state"], episode_ends=np.array(ENDS), meta=meta)
    return path / "it.npz"


def as_zarr(path: Path, version: int = 2, compressor: Any = "auto", zipped: bool = False, **more: np.ndarray) -> Path:
    """As the replay buffers that Diffusion Policy publishes."""
    target = path / "it.zarr"
    group = zarr.open_group(str(target), mode="w", zarr_format=version)
    given = {} if compressor == "auto" else {"compressors": compressor}
    for name, array in {**arrays(), **more}.items():
        group.create_array(f"data/{name}", data=array, chunks=(4, *array.shape[1:]), **given)
    group.create_array("meta/episode_ends", data=np.array(ENDS))
    return Path(shutil.make_archive(str(target), "zip", target)) if zipped else target


def as_hdf5(path: Path) -> Path:
    """As robomimic writes them; episode 10 comes after episode 2."""
    with h5py.File(path / "it.hdf5", "w") as file:
        for demo, begin, end in (("demo_2", 0, ENDS[0]), ("demo_10", *ENDS)):
            for name, array in arrays().items():
                file.create_dataset(f"data/{demo}/obs/{name}", data=array[begin:end], compression="gzip")
            file[f"data/{demo}/actions"] = np.zeros((end - begin, 2))
    return path / "it.hdf5"


def png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def as_lerobot(path: Path, features: dict[str, Any] | None = None) -> Path:
    """Two tables, the rows of the second episode backwards."""
    root = path / "it"
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "features": features or {}}))
    held = arrays()
    for number, rows in enumerate((range(5), range(8, 4, -1))):
        table = {
            "keypoint": [held["keypoint"][i].tolist() for i in rows],
            "state": pa.FixedSizeListArray.from_arrays(held["state"][list(rows)].ravel(), 5),
            "img": [{"bytes": png(held["img"][i]), "path": None} for i in rows],
            "episode_index": [number] * len(rows),
            "frame_index": [i - 5 * number for i in rows],
            "task_name": ["push"] * len(rows),
        }
        file = root / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(table), file)
    return root
