"""A LeRobot data set directory, version 2 or 3: ``meta/info.json`` and tables ``data/**/*.parquet``, a row a frame.

Images are in the tables, or in videos (``lerobot_video``).
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.tokenizer import TASK
from ..core.untrusted_json import parse_json
from ..errors import TrajectoryError
from .frames import Array, Recording, one_error, require_files, require_proportion
from .lerobot_video import video_frames

EPISODE, FRAME, TIME, TASKS = "episode_index", "frame_index", "timestamp", "task_index"
MAX_INFO = 64 * 2**20
"""Bytes of ``meta/info.json``."""
ROWS, IMAGES = 4096, 8
"""Rows that are decoded at once: a table of rows that are all the same is a thousandth of what it holds."""


def lerobot_recording(path: Path) -> Recording:
    """Open a data set. Raises TrajectoryError: not one, or damaged."""
    import pyarrow.parquet as parquet

    require_files(path / "data")
    require_files(path / "meta")
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise TrajectoryError(f"{path}: has meta/info.json and no data/**/*.parquet; expected a LeRobot data set.")
    size = sum(file.stat().st_size for file in files)
    hint = "; expected a LeRobot data set, whose features it names"
    with one_error(f"{path}: meta/info.json cannot be read", hint):
        info = parse_json((path / "meta" / "info.json").read_bytes(), MAX_INFO)
        videos = [name for name, feature in info["features"].items() if feature.get("dtype") == "video"]
    hint = f"; expected tables with the columns {EPISODE} and {FRAME}"
    with one_error(f"{path}: cannot be read as a LeRobot data set", hint):
        tables = [parquet.ParquetFile(file) for file in files]
        names = [name for name in tables[0].schema_arrow.names if name not in (EPISODE, FRAME)]
        episodes, numbers = (_index(path, tables, name, size) for name in (EPISODE, FRAME))
    if len(episodes) != len(numbers):
        raise TrajectoryError(f"{path}: {EPISODE} has {len(episodes)} rows, and {FRAME} {len(numbers)}.")
    order = np.lexsort((numbers, episodes))
    ends = np.append(np.flatnonzero(np.diff(episodes[order])) + 1, len(order))

    told = TASKS in names and TASK not in names and any((path / "meta").glob("tasks.*"))

    def read(name: str) -> tuple[int, Iterator[Array]]:
        if name == TASK and told:
            return len(order), _texts(path, _index(path, tables, TASKS, size))
        if name in videos:
            times = np.concatenate([np.zeros(0, np.float32), *_column(path, tables, TIME, size)])
            return len(order), video_frames(path, name, info, episodes, times, columns)
        return len(order), _column(path, tables, name, size)

    def columns(files: Sequence[Path], name: str) -> Array:
        return np.concatenate(list(_column(path, [parquet.ParquetFile(file) for file in files], name, size)))

    sorted_already = bool((order == np.arange(len(order))).all())
    return Recording([*names, *videos, *([TASK] if told else [])], read, ends, None if sorted_already else order)


def _index(path: Path, tables: list[Any], name: str, size: int) -> Array:
    found = list(_column(path, tables, name, size))
    whole = np.concatenate(found) if found else np.zeros(0, np.int64)
    if whole.ndim != 1 or whole.dtype.kind not in "iu":
        raise TrajectoryError(f"{path}: column {name!r} is {whole.dtype}{list(whole.shape)}; expected integers [F].")
    return whole


def _texts(path: Path, numbers: Array) -> Iterator[Array]:
    """The instruction of each row, as the bytes of its text with zeros after them, ``[n, L]``."""
    lines = path / "meta" / "tasks.jsonl"
    with one_error(f"{path}: meta/{lines.stem} cannot be read", ", which says what each task_index is in words"):
        if lines.exists():  # version 2
            rows = [parse_json(line, MAX_INFO) for line in lines.read_bytes().splitlines() if line]
            texts = {int(row[TASKS]): str(row[TASK]) for row in rows}
        else:
            import pyarrow.parquet as parquet

            table = parquet.read_table(lines.with_suffix(".parquet"), use_threads=False)
            (name,) = (each for each in table.column_names if each != TASKS)
            texts = dict(zip(table[TASKS].to_pylist(), map(str, table[name].to_pylist()), strict=True))
        different, places = np.unique(numbers, return_inverse=True)
        coded = np.array([texts[number].encode() for number in different.tolist()])
    for begin in range(0, len(numbers), ROWS):
        yield coded[places[begin : begin + ROWS], None].view(np.uint8)


def _column(path: Path, tables: list[Any], name: str, size: int) -> Iterator[Array]:
    """The rows of a column, a few at a time; ends where they are more than the files can hold."""
    total = 0
    with one_error(f"{path}: column {name!r} is damaged"):
        for table in tables:
            images = _images_or_numbers(path, name, table.schema_arrow.field(name).type)
            for batch in table.iter_batches(IMAGES if images else ROWS, columns=[name], use_threads=False):
                values = batch.column(0)
                rows = (_image(path, name, value)[None] for value in values.to_pylist()) if images else [_rows(values)]
                for block in rows:
                    total += block.nbytes
                    require_proportion(path, total, size)
                    yield block


def _images_or_numbers(path: Path, name: str, kind: Any) -> bool:
    from pyarrow import types

    if types.is_struct(kind):
        return True
    inner = kind
    while types.is_list(inner) or types.is_large_list(inner) or types.is_fixed_size_list(inner):
        inner = inner.value_type
    if not (types.is_integer(inner) or types.is_floating(inner) or types.is_boolean(inner)):
        raise TrajectoryError(f"{path}: column {name!r} is {kind}; expected numbers or images.")
    return False


def _rows(values: Any) -> Array:
    """Numbers as ``[n, ...]``, of lists of lists a level at a time."""
    import pyarrow
    from pyarrow import compute

    count, inner = len(values), []
    while pyarrow.types.is_nested(values.type):
        lengths = compute.unique(compute.list_value_length(values)).to_pylist()
        if len(lengths) != 1 or lengths[0] is None:
            raise ValueError(f"lists of {str(lengths)[:80]} values; expected as many in every row")
        inner.append(lengths[0])
        values = values.flatten()
    if values.null_count:
        raise ValueError("missing values")
    return np.asarray(values).reshape(count, *inner)


def _image(path: Path, name: str, value: Any) -> Array:
    from PIL import Image

    content = value.get("bytes") if value is not None else None
    if not isinstance(content, bytes):
        raise TrajectoryError(f"{path}: the images of {name!r} are not in the table; expected them embedded.")
    with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        require_proportion(path, image.width * image.height * 3, len(content))
        return np.asarray(image.convert("RGB"))
