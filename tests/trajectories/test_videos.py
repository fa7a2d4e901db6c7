"""LeRobot data sets whose images are in videos."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import frames, load_trajectories, sandbox

from .data_sets import ENDS, as_lerobot_with_videos, read_here, shade, write_video

SPECS = {"top": ObservationSpec((2, 3, 16, 32)), "state": ObservationSpec((2, 5))}
SHADES = 8 / 255
"""What an encoder may change of a colour: six with one version of SVT-AV1. From frame to frame colours change more."""


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a process for every reading."""
    monkeypatch.setattr(sandbox, "reader", read_here)


@pytest.mark.slow
@pytest.mark.parametrize(("version", "codec"), [(3, "libx264"), (2, "libx264"), (3, "libsvtav1"), (3, "libx265")])
def test_frames_are_those_of_their_rows(tmp_path: Path, version: int, codec: str) -> None:
    """In a process of its own, with its limits; the rows of the second episode are stored backwards."""
    episodes = load_trajectories([as_lerobot_with_videos(tmp_path, version, codec)], SPECS, 2)
    assert [episode.calls for episode in episodes] == [3, 2]
    for first, episode in zip((0, ENDS[0]), episodes, strict=True):
        found = episode.observations["top"]
        newest = np.array([shade(first + 2 * call) for call in range(episode.calls)], np.float32) / 255
        wanted = np.broadcast_to(newest[:, :, None, None], (episode.calls, 3, 16, 32))
        np.testing.assert_allclose(found[:, 1], wanted, atol=SHADES)
        before = np.array([shade(first + max(0, 2 * call - 1)) for call in range(episode.calls)], np.float32) / 255
        np.testing.assert_allclose(found[:, 0, :, 7, 9], before, atol=SHADES)


@pytest.mark.parametrize("block", [None, 64])
def test_a_policy_of_one_frame_sees_those_of_its_calls(
    tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch, block: int | None
) -> None:
    """Whether the pictures are kept in memory or, where they are many, on disk."""
    if block is not None:
        monkeypatch.setattr(sandbox, "BLOCK_BYTES", block)
    specs = {"top": ObservationSpec((1, 3, 16, 32)), "state": ObservationSpec((5,))}
    root = as_lerobot_with_videos(tmp_path)
    one, two = (load_trajectories([root], given, 2) for given in (specs, SPECS))
    assert [episode.calls for episode in one] == [3, 2]
    for each, other in zip(one, two, strict=True):
        assert type(each.observations["top"]) is np.ndarray, "nothing else is told of the file on disk"
        np.testing.assert_array_equal(each.observations["top"][:, 0], other.observations["top"][:, 1])
        np.testing.assert_array_equal(each.observations["state"], other.observations["state"][:, 1])


def test_only_the_frames_of_calls_become_floats(tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[int]()
    whole = frames._as_image

    def counted(array: np.ndarray, spec: ObservationSpec) -> np.ndarray:
        seen.append(len(array))
        return whole(array, spec)

    monkeypatch.setattr(frames, "_as_image", counted)
    load_trajectories([as_lerobot_with_videos(tmp_path)], {"top": ObservationSpec((1, 3, 16, 32))}, 4)
    assert seen == [3], "of nine frames, calls begin with these"


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="this system has no scheduling policies")
def test_an_encoder_leaves_the_priority_of_the_tests_alone(tmp_path: Path) -> None:
    before = os.sched_getscheduler(0)
    write_video(tmp_path / "one.mp4", 0, 3, "libsvtav1")
    assert os.sched_getscheduler(0) == before


def _episodes(root: Path, **columns: list[Any]) -> None:
    file = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(pa.table({name: columns.get(name, table[name]) for name in table.column_names}), file)


def _info(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    info = json.loads((root / "meta" / "info.json").read_text())
    change(info)
    (root / "meta" / "info.json").write_text(json.dumps(info))


FILE = Path("videos/top/chunk-000/file-000.mp4")
DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (
        lambda root: (root / FILE).unlink(),
        "file-000.mp4 cannot be decoded .*FileNotFoundError.*Copy it again",
    ),
    "cut": (lambda root: (root / FILE).write_bytes((root / FILE).read_bytes()[:900]), "cannot be decoded"),
    "no video": (lambda root: (root / FILE).write_bytes(b"text"), "cannot be decoded"),
    "short": (
        lambda root: write_video(root / FILE, 0, 7),
        r"the video ends before 0\.[78]00 s, where a row has a frame",
    ),
    "codec": (lambda root: write_video(root / FILE, 0, 9, "mpeg4"), "the video is mpeg4; expected one of h264, hevc"),
    "between": (lambda root: _episodes(root, **{"videos/top/from_timestamp": [-0.4, 0.5]}), "has no frame at -0.400 s"),
    "no time": (
        lambda root: _episodes(root, **{"videos/top/from_timestamp": [0.0, float("nan")]}),
        r"the time of row \d+ in the videos of 'top' is nan; expected finite seconds",
    ),
    "episode": (lambda root: _episodes(root, episode_index=[0, 7]), r"there is no video 'top' of the episodes \[1\]"),
    "fps": (lambda root: _info(root, lambda info: info.pop("fps")), "fps of meta/info.json is None; expected frames"),
    "depth": (
        lambda root: _info(root, lambda info: info["features"]["top"].update(info={"video.is_depth_map": True})),
        "a video of depths, which is not decoded",
    ),
    "depth of lerobot 0.6": (
        lambda root: _info(root, lambda info: info["features"]["top"].update(info={"is_depth_map": True})),
        "a video of depths, which is not decoded",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.usefixtures("here")
def test_damage_is_one_error(tmp_path: Path, damage: str) -> None:
    root = as_lerobot_with_videos(tmp_path)
    harm, message = DAMAGES[damage]
    harm(root)
    with pytest.raises(TrajectoryError, match=message) as caught:
        load_trajectories([root], SPECS, 2)
    assert str(root) in str(caught.value)


@pytest.mark.usefixtures("here")
def test_nothing_may_be_known_of_a_video(tmp_path: Path) -> None:
    root = as_lerobot_with_videos(tmp_path)
    _info(root, lambda info: info["features"]["top"].update(info=None))
    assert [episode.calls for episode in load_trajectories([root], SPECS, 2)] == [3, 2]


@pytest.mark.usefixtures("here")
def test_without_pyav_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = as_lerobot_with_videos(tmp_path)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(TrajectoryError, match=r"package 'av', .*not installed.*'ttscompile\[videos\]', or save"):
        load_trajectories([root], SPECS, 2)
    assert len(load_trajectories([root], {"state": SPECS["state"]}, 2)) == 2, "who needs no video needs no decoder"


@pytest.mark.usefixtures("here")
def test_a_camera_is_no_way_out_of_the_data_set(tmp_path: Path) -> None:
    root = as_lerobot_with_videos(tmp_path)
    _info(root, lambda info: info["features"].update({"../top": info["features"]["top"]}))
    with pytest.raises(TrajectoryError, match="is no name of a camera"):
        load_trajectories([root], SPECS, 2, {"top": ("../top",)})
