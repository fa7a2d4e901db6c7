"""A LeRobot data set directory, version 2 or 3: ``meta/info.json`` and tables ``data/**/*.parquet``, a row a frame.

Images are in the tables, or in videos. Of these version 2 has a file for each episode, version 3 files of many, and
tables ``meta/episodes/**/*.parquet`` that say where in them an episode begins. Frames are found by their times, as
LeRobot does it.
"""

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ..core.coercion import Array
from ..core.tokenizer import TASK
from ..core.untrusted_json import parse_json
from ..errors import TrajectoryError
from .frames import Recording, one_error, require_files, require_proportion

EPISODE, FRAME, TIME, TASKS = "episode_index", "frame_index", "timestamp", "task_index"
MAX_INFO = 64 * 2**20
"""Bytes of ``meta/info.json``."""
ROWS, IMAGES = 4096, 8
"""Rows that are decoded at once: a table of rows that are all the same is a thousandth of what it holds."""


def lerobot_recording(path: Path, most: int | None = None) -> Recording:
    """Open a data set; of its first ``most`` episodes, if that is given, those whose videos are there."""
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
        tables = [_table(file) for file in files]
        names = [name for name in tables[0].schema_arrow.names if name not in (EPISODE, FRAME)]
        episodes, numbers = (_index(path, tables, name, size) for name in (EPISODE, FRAME))
    if len(episodes) != len(numbers):
        raise TrajectoryError(f"{path}: {EPISODE} has {len(episodes)} rows, and {FRAME} {len(numbers)}.")
    order = np.lexsort((numbers, episodes))
    ends, total = _ends(path, episodes[order], numbers[order]), info.get("total_frames")
    counted = f"{path}: meta/info.json counts {total} frames, and data/ has {len(order)}: the others are left out"
    fewer = most is None and isinstance(total, int) and total > len(order)
    notes = [f"{counted}. If they should be there, copy it again."] * fewer

    told = TASKS in names and TASK not in names and any((path / "meta").glob("tasks.*"))

    def read(name: str) -> tuple[int, Iterator[Array]]:
        if name == TASK and told:
            return len(episodes), _texts(path, _index(path, tables, TASKS, size))
        if name in videos:
            times = np.concatenate([np.zeros(0, np.float32), *_column(path, tables, TIME, size)])
            rows = len(episodes) if most is None else int(order.max()) + 1
            return rows, video_frames(path, name, info, episodes[:rows], times[:rows], columns)
        found = _column(path, tables, name, size)
        if info["features"].get(name, {}).get("shape") == [1]:  # the tables have the number alone
            found = (block.reshape(len(block), -1) for block in found)
        return len(episodes), found

    def columns(files: Sequence[Path], name: str) -> Array:
        return np.concatenate(list(_column(path, [_table(file) for file in files], name, size)))

    if most is not None:
        files_of = [_begins(path, name, info, columns) for name in videos]
        first = episodes[order[ends - 1]].tolist()[:most]
        lacking = (i for i, n in enumerate(first) if not all(n in each and each[n][0].is_file() for each in files_of))
        ends = ends[: next(lacking, len(first))]
        if not len(ends):
            raise TrajectoryError(f"{path}: the first episode has no videos of {', '.join(videos)} in the first files.")
        order = order[: ends[-1]]
    stored = None if np.array_equal(order, np.arange(len(episodes))) else order
    return Recording([*names, *videos, *([TASK] if told else [])], read, ends, stored, notes)


def _table(file: Path) -> Any:
    import pyarrow.parquet as parquet

    with one_error(f"{file}: is no whole table", ". Copy it again, or take it out of the data set"):
        return parquet.ParquetFile(file)


def _ends(path: Path, episodes: Array, numbers: Array) -> Array:
    """For each episode the row after its last, where rows are in order. Raises TrajectoryError: one lacks frames."""
    same = np.diff(episodes) == 0
    for i in np.flatnonzero(same & (np.diff(numbers) != 1))[:1]:
        told = f"after frame {numbers[i]} of episode {episodes[i]} comes frame {numbers[i + 1]}; expected each once"
        raise TrajectoryError(f"{path}: {told}. Is a file of data/ there twice, or missing?")
    return np.append(np.flatnonzero(~same) + 1, len(episodes))


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


CODECS = ("h264", "hevc", "av1", "libdav1d")
"""Decoders of what LeRobot writes. FFmpeg has hundreds, most of them old."""

Column = Callable[[Sequence[Path], str], Array]
"""A column of some tables, whole."""

_PLACE = ("chunk_index", "file_index", "from_timestamp")


def video_frames(
    path: Path, name: str, info: Mapping[str, Any], episodes: Array, times: Array, column: Column
) -> Iterator[Array]:
    """The frames of one camera, uint8 ``[1, H, W, 3]`` each, in the order of the rows.

    Args:
        info: ``meta/info.json``.
        episodes: ``[F]`` the episode of each row.
        times: ``[F]`` seconds since its episode began, of each row.

    Raises:
        ModuleNotFoundError: PyAV is not installed.
        TrajectoryError: a video is missing or damaged, of another codec, or lacks a frame; a time is not finite.
    """
    import av  # noqa: F401  # told before anything is looked for

    fps: Any = info.get("fps")
    if type(fps) not in (int, float) or not 0 < fps < 1e6:
        raise TrajectoryError(f"{path}: fps of meta/info.json is {fps!r:.80}; expected frames a second of {name!r}.")
    told = info["features"][name].get("info") or {}
    if told.get("is_depth_map") or told.get("video.is_depth_map"):  # the latter before lerobot 0.6
        raise TrajectoryError(f"{path}: {name!r} is a video of depths, which is not decoded. Leave that camera out.")
    if Path(name).name != name:
        raise TrajectoryError(f"{path}: {name!r:.80} is no name of a camera; expected one without folders.")
    require_files(path / "videos")
    begins = _begins(path, name, info, column)
    missing = sorted(set(episodes.tolist()) - set(begins))
    if missing:
        raise TrajectoryError(f"{path}: there is no video {name!r} of the episodes {missing[:5]}. Copy it again.")
    wanted = [(begins[n][0], begins[n][1] + time) for n, time in zip(episodes.tolist(), times.tolist(), strict=True)]
    row = next((i for i, (_, time) in enumerate(wanted) if not math.isfinite(time)), None)
    if row is not None:
        told = f"{path}: the time of row {row} in the videos of {name!r} is {wanted[row][1]}; expected finite seconds"
        raise TrajectoryError(f"{told}. Copy it again.")
    for file, group in groupby(wanted, key=lambda each: each[0]):
        with one_error(f"{path}: the video {file.relative_to(path)} cannot be decoded", ". Copy it again"):
            seconds = [time for _, time in group]
            back = np.cumsum(np.diff(seconds, prepend=seconds[0]) < 0)  # where times go back the file is opened again
            for _, rising in groupby(zip(seconds, back, strict=True), lambda each: each[1]):
                yield from _forward(file, [time for time, _ in rising], 0.5 / fps)


def _begins(path: Path, name: str, info: Mapping[str, Any], column: Column) -> dict[int, tuple[Path, float]]:
    """The file and the second in which each episode begins."""
    tables = sorted((path / "meta" / "episodes").rglob("*.parquet"))
    if tables:
        numbers, *places = (column(tables, each) for each in (EPISODE, *(f"videos/{name}/{of}" for of in _PLACE)))
        rows = zip(numbers.tolist(), *(place.tolist() for place in places), strict=True)
        folder = path / "videos" / name
        return {int(n): (folder / f"chunk-{int(c):03d}" / f"file-{int(f):03d}.mp4", float(t)) for n, c, f, t in rows}
    files = (path / "videos").glob(f"chunk-*/{name}/episode_*.mp4")
    return {int(file.stem.removeprefix("episode_")): (file, 0.0) for file in files}


def _forward(file: Path, times: Sequence[float], half: float) -> Iterator[Array]:
    import av

    # By an open file, so that FFmpeg opens no other that the container may name.
    with file.open("rb") as handle, av.open(handle, "r", format="mp4") as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        if codec.name not in CODECS:
            raise TrajectoryError(f"{file}: the video is {codec.name}; expected one of {', '.join(CODECS)}.")
        codec.thread_count = 1
        decoded = iter(container.decode(stream))
        shown: Any = None
        for time in times:
            while shown is None or shown.time < time - half:
                shown = next(decoded, None)
                if shown is None:
                    raise TrajectoryError(f"{file}: the video ends before {time:.3f} s, where a row has a frame.")
            if shown.time > time + half:
                raise TrajectoryError(
                    f"{file}: the video has no frame at {time:.3f} s; the next is at {shown.time:.3f}."
                )
            yield shown.to_ndarray(format="rgb24")[None]
