"""Data sets as users have them, written with the libraries that write them."""

import io
import itertools
import json
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import zarr
from PIL import Image

from ttscompile.core.spec import ObservationSpec
from ttscompile.trajectories import sandbox

LOW = {"obs": ObservationSpec((2, 8))}
IMAGES = {"image": ObservationSpec((2, 3, 5, 4)), "state": ObservationSpec((2, 5))}
SOURCES = {"obs": ("keypoint", "state:2")}
ENDS = [5, 9]
FPS = 10


@contextmanager
def read_here(request: Mapping[str, Any]) -> Iterator[BinaryIO]:
    """What the process that reads data sets does, without one: it takes half a second."""
    out = io.BytesIO()
    sandbox.serve(request, out)
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


def as_zarr(
    path: Path, version: Literal[2, 3] = 2, compressor: Any = "auto", zipped: bool = False, **more: np.ndarray
) -> Path:
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
        for demo, begin, end in (("demo_2", 0, ENDS[0]), ("demo_10", ENDS[0], ENDS[1])):
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
            "timestamp": np.array([(i - 5 * number) / FPS for i in rows], np.float32),
            "task_name": ["push"] * len(rows),
        }
        file = root / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(table), file)
    return root


def as_lerobot_with_videos(path: Path, version: int = 3, codec: str = "libx264") -> Path:
    """The same with a camera ``top``: version 3 has both episodes in one file, version 2 a file for each."""
    feature = {"dtype": "video", "shape": [16, 32, 3], "names": ["height", "width", "channels"]}
    root = as_lerobot(path, {"top": feature})
    info = json.loads((root / "meta" / "info.json").read_text()) | {"fps": FPS}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    parts = [*itertools.pairwise((0, *ENDS))]
    if version == 2:
        for number, (begin, end) in enumerate(parts):
            write_video(root / "videos" / "chunk-000" / "top" / f"episode_{number:06d}.mp4", begin, end, codec)
        return root
    write_video(root / "videos" / "top" / "chunk-000" / "file-000.mp4", 0, ENDS[-1], codec)
    places = {"chunk_index": [0, 0], "file_index": [0, 0], "from_timestamp": [begin / FPS for begin, _ in parts]}
    table = {"episode_index": [0, 1]} | {f"videos/top/{of}": values for of, values in places.items()}
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    parquet.write_table(pa.table(table), root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    return root


def write_video(file: Path, begin: int, end: int, codec: str = "libx264") -> None:
    """Frames of one colour each, which ``shade`` gives.

    In a thread of its own: where it may, libsvtav1 gives the thread that calls it the highest real-time priority, and
    leaves it there, so that all tests after it would take the processor from every other process.
    """
    with ThreadPoolExecutor(1) as thread:
        thread.submit(_write_video, file, begin, end, codec).result()


def _write_video(file: Path, begin: int, end: int, codec: str) -> None:
    import av

    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for i in range(begin, end):
            frame = av.VideoFrame.from_ndarray(np.full((16, 32, 3), shade(i), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def shade(frame: int) -> list[int]:
    """The colour of a frame: each has its own."""
    return [20 + 20 * frame, 220 - 20 * frame, 120]
