"""The videos of a LeRobot data set: its frames by the row of the tables that they belong to.

Version 2 has a file for each episode, version 3 files of many, and tables ``meta/episodes/**/*.parquet`` that say where
in them an episode begins. Frames are found by their times, as LeRobot does it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TrajectoryError
from .frames import Array, one_error, require_files

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
        path: of the data set.
        name: of the camera.
        info: ``meta/info.json``.
        episodes: ``[F]`` the episode of each row.
        times: ``[F]`` seconds since its episode began, of each row.
        column: reads tables.

    Raises:
        ModuleNotFoundError: PyAV is not installed.
        TrajectoryError: a video is missing or damaged, of another codec, or lacks a frame; a
            time is not finite.
    """
    import av  # noqa: F401

    fps: Any = info.get("fps")
    if type(fps) not in (int, float) or not 0 < fps < 1e6:
        raise TrajectoryError(f"{path}: fps of meta/info.json is {fps!r:.80}; expected frames a second of {name!r}.")
    if info["features"][name].get("info", {}).get("video.is_depth_map"):
        raise TrajectoryError(f"{path}: {name!r} is a video of depths, which is not decoded. Leave that camera out.")
    if Path(name).name != name:
        raise TrajectoryError(f"{path}: {name!r:.80} is no name of a camera; expected one without folders.")
    require_files(path / "videos")
    begins = _begins(path, name, info, column)
    missing = sorted(set(episodes.tolist()) - set(begins))
    if missing:
        raise TrajectoryError(f"{path}: there is no video {name!r} of the episodes {missing[:5]}. Copy it again.")
    wanted = [
        (begins[episode][0], begins[episode][1] + time)
        for episode, time in zip(episodes.tolist(), times.tolist(), strict=True)
    ]
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
        numbers, *places = (
            column(tables, each) for each in ("episode_index", *(f"videos/{name}/{of}" for of in _PLACE))
        )
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
