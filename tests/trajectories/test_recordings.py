"""Data sets as users have them, written with the libraries that write them, and read as the calls of a policy."""

import json
import os
import shutil
from pathlib import Path
from typing import Any, Literal

import h5py
import numcodecs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import zarr

from tests.hostile.pickles import Runs
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import Episode, frames as trajectories_frames, load_trajectories, sandbox

from .data_sets import ENDS, IMAGES, LOW, SOURCES, arrays, as_hdf5, as_lerobot, as_npz, as_zarr, read_here


@pytest.fixture(autouse=True)
def _read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sandbox, "reader", read_here)


WRITERS = {
    "npz": as_npz,
    "zarr 2": as_zarr,
    "zarr 3": lambda path: as_zarr(path, 3),
    "zarr 2, blosc, zipped": lambda path: as_zarr(path, 2, numcodecs.Blosc("zstd"), zipped=True),
    "hdf5": as_hdf5,
    "lerobot": as_lerobot,
}


def windows(frames: np.ndarray, action_steps: int) -> list[np.ndarray]:
    """By hand: the frame of a call and the one before it; the first stands for the one before the first."""
    found = []
    for begin, end in zip([0, *ENDS], ENDS, strict=False):
        calls = range(begin, end, action_steps)
        found.append(np.stack([frames[[max(i - 1, begin), i]] for i in calls]))
    return found


def require_equal(episodes: list[Episode], key: str, expected: list[np.ndarray]) -> None:
    assert len(episodes) == len(expected) == 2
    for episode, one in zip(episodes, expected, strict=True):
        np.testing.assert_allclose(episode.observations[key], one, rtol=1e-6)


@pytest.mark.parametrize("format", WRITERS)
def test_an_observation_is_joined_from_the_arrays_of_a_recording(format: str, tmp_path: Path) -> None:
    held = arrays()
    frames = np.concatenate([held["keypoint"].reshape(9, 6), held["state"][:, :2]], axis=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: pytest.fail("a warning"))
        episodes = load_trajectories([WRITERS[format](tmp_path)], LOW, 3, SOURCES)
    require_equal(episodes, "obs", windows(frames, 3))


@pytest.mark.parametrize("format", WRITERS)
def test_a_policy_knows_what_its_observation_was_made_of(format: str, tmp_path: Path) -> None:
    knows = {"obs": ObservationSpec((2, 8), recorded=SOURCES["obs"])}
    recording = WRITERS[format](tmp_path)
    made, said = (load_trajectories([recording], *how) for how in ((knows, 3), (LOW, 3, SOURCES)))
    require_equal(made, "obs", [each.observations["obs"] for each in said])
    lacks = {"obs": ObservationSpec((2, 8), recorded=("keypoint", "pose"))}
    with pytest.raises(TrajectoryError, match=r"no array 'obs' .*--observation obs=NAME"):
        load_trajectories([recording], lacks, 3)


def test_an_array_of_its_own_name_is_taken_unless_others_are_said(tmp_path: Path) -> None:
    knows = {"obs": ObservationSpec((2, 8), recorded=SOURCES["obs"])}
    own = np.arange(72, dtype=np.float32).reshape(9, 8)
    recording = as_zarr(tmp_path, obs=own)
    require_equal(load_trajectories([recording], knows, 3), "obs", windows(own, 3))
    said = load_trajectories([recording], LOW, 3, SOURCES)
    require_equal(load_trajectories([recording], knows, 3, SOURCES), "obs", [each.observations["obs"] for each in said])


@pytest.mark.parametrize("format", ["zarr 2", "zarr 3", "hdf5", "lerobot"])
def test_images_come_as_the_policy_takes_them(format: str, tmp_path: Path) -> None:
    episodes = load_trajectories([WRITERS[format](tmp_path)], IMAGES, 2, {"image": ("img",)})
    held = arrays()
    require_equal(episodes, "image", windows(np.moveaxis(held["img"], -1, 1).astype(np.float32) / 255, 2))
    require_equal(episodes, "state", windows(held["state"], 2))


@pytest.mark.parametrize("format", WRITERS)
def test_what_is_missing_is_named_beside_what_there_is(format: str, tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"no array 'obs' .* it has .*keypoint, .*state.*--observation obs=NAME"):
        load_trajectories([WRITERS[format](tmp_path)], LOW, 3)


@pytest.mark.parametrize("part", ["state:0", "state:6", "state:x", "state:"])
def test_more_numbers_than_there_are_cannot_be_taken(part: str, tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=f"'{part}' .* how many of the 5 numbers of 'state' are taken"):
        load_trajectories([as_npz(tmp_path)], LOW, 3, {"obs": ("keypoint", part)})


def test_calls_are_not_joined(tmp_path: Path) -> None:
    np.savez(tmp_path / "calls.npz", a=np.zeros((3, 2, 4)), b=np.zeros((3, 2, 4)), episode_ends=np.array([3]))
    with pytest.raises(TrajectoryError, match="its rows are calls of the policy"):
        load_trajectories([tmp_path / "calls.npz"], LOW, 3, {"obs": ("a", "b")})


def test_an_array_for_no_key_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"observes \['obs'\]; found arrays for \['observation'\]"):
        load_trajectories([as_npz(tmp_path)], LOW, 3, {"observation": ("state",)})


@pytest.mark.parametrize("declared", ["|O", "<f4"])
def test_a_zarr_codec_that_unpickles_is_never_run(declared: str, tmp_path: Path) -> None:
    target, store = tmp_path / "touched", as_zarr(tmp_path)
    array = store / "data" / "state"
    payload = np.empty(4, object)
    payload[:] = Runs(os.mkdir, str(target))
    (array / "0.0").write_bytes(numcodecs.Pickle().encode(payload))
    meta = json.loads((array / ".zarray").read_text())
    meta |= {"dtype": declared, "filters": [{"id": "pickle", "protocol": 5}], "compressor": None, "fill_value": 0}
    (array / ".zarray").write_text(json.dumps(meta))
    with pytest.raises(TrajectoryError):
        load_trajectories([store], LOW, 3, SOURCES)
    assert not target.exists()


def test_pictures_in_a_codec_of_another_library(tmp_path: Path) -> None:
    """As Diffusion Policy caches those of robomimic; the message says which codecs are read, and what to do."""
    store = as_zarr(tmp_path)
    meta = json.loads((store / "data" / "img" / ".zarray").read_text())
    meta["compressor"] = {"id": "imagecodecs_jpeg2k", "level": 50}
    (store / "data" / "img" / ".zarray").write_text(json.dumps(meta))
    with pytest.raises(TrajectoryError, match="imagecodecs_jpeg2k.* one of blosc, .*Write it again with such a compr"):
        load_trajectories([store], LOW, 3, SOURCES)


def test_poses_that_are_not_those_of_the_policy(tmp_path: Path) -> None:
    """As UMI records them, whatever else is there; with or without pictures in a codec of another library."""
    store = as_zarr(tmp_path, robot0_demo_start_pose=np.zeros((9, 6)))
    (store / "data" / "img" / ".zarray").write_text("{}")
    with pytest.raises(TrajectoryError, match=r"of UMI has the robot's poses, .* newest one\. So save the .* \.npz"):
        load_trajectories([store], LOW, 3, SOURCES)


def test_a_zarr_array_of_nothing_but_its_size_is_refused(tmp_path: Path) -> None:
    store = as_zarr(tmp_path)
    shutil.rmtree(store / "data" / "state")
    data: Any = zarr.open_group(str(store))["data"]
    data.create_array("state", shape=(10**9, 5), chunks=(1000, 5), dtype="f4")
    with pytest.raises(TrajectoryError, match="in proportion to a file of"):
        load_trajectories([store], LOW, 3, SOURCES)


def test_data_of_other_files_is_not_read(tmp_path: Path) -> None:
    path = as_hdf5(tmp_path)
    (tmp_path / "secret").write_bytes(bytes(100))
    with h5py.File(path, "r+") as file:
        del file["data/demo_2/obs/state"]
        file.create_dataset("data/demo_2/obs/state", (5, 5), "f4", external=[(str(tmp_path / "secret"), 0, 100)])
    with pytest.raises(TrajectoryError, match="with its data in other files; expected numbers in the file itself"):
        load_trajectories([path], LOW, 3, SOURCES)
    with h5py.File(path, "r+") as file:
        del file["data/demo_2/obs/state"]
        file["data/demo_2/obs/state"] = h5py.ExternalLink("other.hdf5", "/state")
    with pytest.raises(TrajectoryError, match="is a link, maybe to another file"):
        load_trajectories([path], LOW, 3, SOURCES)


def test_of_a_vector_of_one_number_lerobot_saves_the_number(tmp_path: Path) -> None:
    path = as_lerobot(tmp_path, {"timestamp": {"dtype": "float32", "shape": [1], "names": None}})
    times = np.array([[i / 10] for n in (5, 4) for i in range(n)], np.float32)
    specs = {"timestamp": ObservationSpec((2, 1)), "state": ObservationSpec((2, 5))}
    episodes = load_trajectories([path], specs, 3)
    require_equal(episodes, "timestamp", windows(times, 3))


@pytest.mark.parametrize(("part", "message"), [("task_name", "is string; expected numbers"), ("nested", "no array")])
def test_columns_of_text_are_refused(part: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=message):
        load_trajectories([as_lerobot(tmp_path)], LOW, 3, {"obs": (part,)})


@pytest.mark.parametrize("format", ["zarr 2", "zarr 2, blosc, zipped", "hdf5", "lerobot"])
def test_damage_is_one_error(format: str, tmp_path: Path) -> None:
    """Every file cut in two, one after the other."""
    path = WRITERS[format](tmp_path)
    files = [path] if path.is_file() else [f for f in sorted(path.rglob("*")) if f.is_file()]
    for file in files:
        content = file.read_bytes()
        file.write_bytes(content[: len(content) // 2])
        try:
            episodes = load_trajectories([path], LOW, 3, SOURCES)
            assert "img" in str(file) or "attrs" in file.name or len(episodes) == 2  # not read, or of no consequence
        except TrajectoryError as error:
            assert str(path) in str(error)  # noqa: PT017
        file.write_bytes(content)
    assert len(load_trajectories([path], LOW, 3, SOURCES)) == 2


@pytest.mark.parametrize("format", ["hdf5", "lerobot"])
def test_arrays_out_of_proportion_are_refused(format: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectories_frames, "FREE_BYTES", 0)
    monkeypatch.setattr(trajectories_frames, "MAX_RATIO", 0)
    with pytest.raises(TrajectoryError, match="in proportion"):
        load_trajectories([WRITERS[format](tmp_path)], LOW, 3, SOURCES)


def test_images_of_another_size_are_resized_where_the_policy_does_that(tmp_path: Path) -> None:
    """Bytes with channels last, as cameras give them; the rest is black, at the top and the left."""
    image = np.full((3, 4, 8, 3), 255, np.uint8)
    path = tmp_path / "calls.npz"
    np.savez(path, top=image, episode_ends=np.array([3]), meta=np.array('{"frames": true}'))
    specs = {"top": ObservationSpec((1, 3, 4, 4), bounds=(0.0, 1.0), fit="start")}
    (episode,) = load_trajectories([path], specs, 1)
    expected = np.zeros((3, 1, 3, 4, 4), np.float32)
    expected[..., 2:, :] = 1
    np.testing.assert_array_equal(episode.observations["top"], expected)


@pytest.mark.parametrize("version", [2, 3])
def test_chunks_that_are_not_there_are_told_of_what_is_read(version: Literal[2, 3], tmp_path: Path) -> None:
    """zarr leaves chunks of nothing but zeros out; one that a copy lost looks the same."""
    path = as_zarr(tmp_path, version)
    chunk = min(file for file in (path / "data" / "state").rglob("*0") if file.is_file())
    chunk.unlink()
    with pytest.warns(UserWarning, match=r"it\.zarr: 1 of 3 chunks of 'state' are not there, and read as 0\.0\. If"):
        first = load_trajectories([path], LOW, 3, SOURCES)[0]
    assert not first.observations["obs"][0, :, 6:].any()
    assert len(load_trajectories([path], LOW, 3, {"obs": ("keypoint", "keypoint:2")})) == 2  # without a warning


@pytest.mark.parametrize("place", ["file-000 (1).parquet", ".ipynb_checkpoints/file-000.parquet"])
def test_a_table_that_is_there_twice_is_not_read_twice(place: str, tmp_path: Path) -> None:
    chunk = as_lerobot(tmp_path) / "data" / "chunk-000"
    (chunk / place).parent.mkdir(exist_ok=True)
    shutil.copy(chunk / "file-000.parquet", chunk / place)
    with pytest.raises(TrajectoryError, match="after frame 0 of episode 0 comes frame 0; expected each once"):
        load_trajectories([tmp_path / "it"], LOW, 3, SOURCES)


def test_a_table_that_lacks_frames_is_refused_and_one_that_is_missing_told(tmp_path: Path) -> None:
    chunk = as_lerobot(tmp_path) / "data" / "chunk-000"
    whole = parquet.read_table(chunk / "file-000.parquet")
    parquet.write_table(pa.concat_tables([whole.slice(0, 2), whole.slice(3)]), chunk / "file-000.parquet")
    with pytest.raises(TrajectoryError, match="after frame 1 of episode 0 comes frame 3; expected each once"):
        load_trajectories([tmp_path / "it"], LOW, 3, SOURCES)
    (chunk / "file-000.parquet").unlink()
    (tmp_path / "it" / "meta" / "info.json").write_text(json.dumps({"features": {}, "total_frames": 9}))
    with pytest.warns(UserWarning, match=r"info\.json counts 9 frames, and data/ has 4: the others are left out"):
        assert len(load_trajectories([tmp_path / "it"], LOW, 3, SOURCES)) == 1


def test_a_file_that_is_no_whole_table_is_named(tmp_path: Path) -> None:
    """As another system leaves one beside each file that it copies."""
    (as_lerobot(tmp_path) / "data" / "chunk-000" / "._file-000.parquet").write_bytes(b"Mac OS X")
    with pytest.raises(TrajectoryError, match=r"chunk-000/\._file-000\.parquet: is no whole table .*take it out"):
        load_trajectories([tmp_path / "it"], LOW, 3, SOURCES)


def test_an_episode_without_frames_is_named(tmp_path: Path) -> None:
    with h5py.File(as_hdf5(tmp_path), "r+") as file:
        file["data/demo_3/obs/keypoint"], file["data/demo_3/obs/state"] = np.zeros((0, 3, 2)), np.zeros((0, 5))
    with pytest.raises(TrajectoryError, match=r"arrays of /data/demo_3/obs differ in length, or are empty: \[0\]"):
        load_trajectories([tmp_path / "it.hdf5"], LOW, 3, SOURCES)
