"""A LeRobot data set directory, version 2 or 3: ``meta/info.json`` and tables ``data/**/*.parquet``, a row a frame."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TrajectoryError
from .frames import Array, Frames, require_package, require_proportion

EPISODE, FRAME = "episode_index", "frame_index"


def lerobot_frames(path: Path) -> Frames:
    """Open a data set.

    Raises:
        TrajectoryError: not one, or damaged.
    """
    try:
        import pyarrow.parquet as parquet
    except ModuleNotFoundError as error:
        raise require_package(path, "pyarrow") from error
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise TrajectoryError(f"{path}: has meta/info.json and no data/**/*.parquet; expected a LeRobot data set.")
    try:
        videos = _videos(path)
        names = [name for name in parquet.read_schema(files[0]).names if name not in (EPISODE, FRAME)]
        index = [_columns(parquet, file, [EPISODE, FRAME]) for file in files]
    except TrajectoryError:
        raise
    except Exception as error:  # pyarrow has its own errors, of several kinds
        raise TrajectoryError(
            f"{path}: cannot be read as a LeRobot data set ({type(error).__name__}: {str(error)[:160]}); expected"
            f" tables with the columns {EPISODE} and {FRAME}."
        ) from error
    episodes, numbers = (np.concatenate([table[name].to_numpy() for table in index]) for name in (EPISODE, FRAME))
    order = np.lexsort((numbers, episodes))
    changes = np.flatnonzero(np.diff(episodes[order])) + 1
    ends = np.append(changes, len(order))

    def read(name: str) -> Array:
        if name in videos:
            raise TrajectoryError(
                f"{path}: {name!r} is a video, which is not decoded. Save its frames as images (LeRobot records a data"
                " set so with --dataset.video=false), or the observations as an .npz."
            )
        try:
            rows = [_rows(path, name, _columns(parquet, file, [name])[name]) for file in files]
        except TrajectoryError:
            raise
        except Exception as error:
            raise TrajectoryError(
                f"{path}: column {name!r} is damaged ({type(error).__name__}: {str(error)[:160]})."
            ) from error
        whole = np.concatenate(rows)
        require_proportion(path, whole.nbytes, sum(file.stat().st_size for file in files))
        return whole[order]

    return Frames([*names, *videos], read, ends)


def _columns(parquet: Any, file: Path, names: list[str]) -> Any:
    return parquet.read_table(file, columns=names, use_threads=False)


def _rows(path: Path, name: str, column: Any) -> Array:
    """A column as ``[F, ...]``; images, which are stored compressed, as ``[F, H, W, C]``."""
    import pyarrow

    values = column.combine_chunks()
    if pyarrow.types.is_struct(values.type):
        return np.stack([_image(path, name, value) for value in values.to_pylist()])
    sizes: list[int] = []
    while pyarrow.types.is_nested(values.type):  # [[..], ..], a level at a time; ragged rows do not reshape
        sizes.append(len(values))
        values = values.flatten()
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise TrajectoryError(f"{path}: column {name!r} is {column.type}; expected numbers or images.")
    inner = [after // before for before, after in zip(sizes, [*sizes[1:], len(array)], strict=True)]
    return array.reshape(len(column), *inner) if sizes else array


def _image(path: Path, name: str, value: dict[str, Any]) -> Array:
    from PIL import Image

    content = value.get("bytes")
    if not isinstance(content, bytes):
        raise TrajectoryError(f"{path}: the images of {name!r} are not in the table; expected them embedded.")
    with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        return np.asarray(image.convert("RGB"))


def _videos(path: Path) -> list[str]:
    """Names of the features that are videos; they are not read, and the error says so."""
    try:
        features = json.loads((path / "meta" / "info.json").read_text("utf-8"))["features"]
        return [name for name, feature in features.items() if feature.get("dtype") == "video"]
    except (OSError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise TrajectoryError(
            f"{path}: meta/info.json cannot be read ({type(error).__name__}: {str(error)[:160]}); expected a LeRobot"
            " data set, whose features it names."
        ) from error
