"""Recordings: what is read, and what is refused with which words."""

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.hostile.pickles import Runs
from ttscompile import Affine, ObservationSpec
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import Episode, load_trajectories

SPECS = {"obs": ObservationSpec((2, 3)), "goal": ObservationSpec((4,), dtype="int64")}


def arrays(calls: int = 5) -> dict[str, Any]:
    obs = np.arange(calls * 6, dtype=np.float32).reshape(calls, 2, 3)
    return {"obs": obs, "goal": np.arange(calls * 4).reshape(calls, 4), "episode_ends": np.array([2, calls])}


def load(path: Path, specs: Mapping[str, ObservationSpec] = SPECS, action_steps: int = 2) -> list[Episode]:
    return load_trajectories([path], specs, action_steps)


def saved(path: Path, **content: Any) -> Path:
    np.savez(path, **content)
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "calls.npz"


def test_calls_are_divided_into_episodes(file: Path) -> None:
    content = arrays()
    first, second = load(saved(file, **content))
    assert (first.calls, second.calls) == (2, 3)
    np.testing.assert_array_equal(first.observations["obs"], content["obs"][:2])
    np.testing.assert_array_equal(second.observations["goal"], content["goal"][2:])
    assert second.name == "calls.npz[1]"


@pytest.mark.parametrize(
    ("content", "found"), [(b"a,b\n1,2\n", "one that begins with b'a,b\\\\n1,'"), (b"", "an empty one")]
)
def test_a_file_that_is_no_archive_is_told_so(file: Path, content: bytes, found: str) -> None:
    file.write_bytes(content)
    with pytest.raises(TrajectoryError, match=f".npz, or the folder of a data set; found {found}") as caught:
        load(file)
    assert "pickle" not in str(caught.value)


def test_an_archive_without_arrays_is_told_so(file: Path) -> None:
    np.savez(file)
    with pytest.raises(TrajectoryError, match="'episode_ends'; it has no arrays at all. Add"):
        load(file)


def test_compressed_files_and_several_files(file: Path, tmp_path: Path) -> None:
    np.savez_compressed(file, **arrays())
    other = saved(tmp_path / "other.npz", **{**arrays(7), "obs": arrays(7)["obs"] + 1})
    assert [e.calls for e in load_trajectories([file, str(other)], SPECS, 2)] == [2, 3, 2, 5]


def test_an_episode_that_is_given_twice_is_used_once(file: Path, tmp_path: Path) -> None:
    """Or it could be learned from and held out."""
    saved(file, **arrays())
    both = saved(tmp_path / "both.npz", **arrays(7))  # the first episode is the same, the second longer
    with pytest.warns(UserWarning, match=r"given before are left out: calls.npz\[0\], calls.npz\[1\], both.npz\[0\]\."):
        episodes = load_trajectories([file, file, both], SPECS, 2)
    assert [episode.name for episode in episodes] == ["calls.npz[0]", "calls.npz[1]", "both.npz[1]"]


def test_numbers_take_the_dtype_of_the_specification(file: Path) -> None:
    content = arrays()
    episodes = load(
        saved(file, **{**content, "obs": content["obs"].astype(np.float64), "goal": content["goal"].astype("u1")})
    )
    assert episodes[0].observations["obs"].dtype == np.float32
    assert episodes[0].observations["goal"].dtype == np.int64


@pytest.mark.parametrize(
    ("action_steps", "ends", "expected"),
    [
        (2, [5], [[[0, 0], [1, 2], [3, 4]]]),
        (3, [5], [[[0, 0], [2, 3]]]),
        (8, [5], [[[0, 0]]]),
        (2, [1, 5], [[[0, 0]], [[1, 1], [2, 3]]]),  # no window reaches into another episode
    ],
)
def test_windows_are_cut_from_frames(file: Path, action_steps: int, ends: list[int], expected: list[Any]) -> None:
    frames = np.arange(5, dtype=np.float32)[:, None]
    saved(file, obs=frames, episode_ends=ends, meta=np.array('{"frames": true}'))
    episodes = load(file, {"obs": ObservationSpec((2, 1))}, action_steps)
    assert [e.observations["obs"][..., 0].tolist() for e in episodes] == expected


def test_meta_without_frames_means_calls(file: Path) -> None:
    assert len(load(saved(file, **arrays(), meta=np.array('{"made_by": "me"}')))) == 2


def test_rows_after_the_last_end_are_left_out_with_a_warning(file: Path) -> None:
    saved(file, **{**arrays(), "episode_ends": np.array([2])})
    with pytest.warns(UserWarning, match="3 rows after the last end of an episode are not used"):
        assert [e.calls for e in load(file)] == [2]


def test_arrays_that_are_no_observation_are_left_out_with_a_warning(file: Path) -> None:
    saved(file, **arrays(), reward=np.zeros(5), action=np.zeros((5, 2)))
    with pytest.warns(UserWarning, match=r"\['reward'\] are no keys of the observation"):
        assert len(load(file)) == 2


def test_actions_that_were_recorded_are_left_out_without_a_warning(file: Path) -> None:
    assert len(load(saved(file, **arrays(), action=np.zeros((5, 2))))) == 2


def changed(**changes: Any) -> dict[str, Any]:
    content = {**arrays(), **changes}
    return {name: value for name, value in content.items() if value is not None}


NAN = np.where(np.arange(30).reshape(5, 2, 3) == 13, np.nan, 0).astype(np.float32)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (changed(obs=None), "has no array 'obs' for the observation 'obs'; it has goal"),
        (changed(obs=None, state=np.zeros((5, 2, 3))), "has no array 'obs'.*; it has goal, state"),
        (
            changed(obs=np.zeros((5, 2, 4), np.float32)),
            r"'obs' has shape \[5, 2, 4\]; expected .* 3\]. Give what this policy",
        ),
        (changed(obs=np.zeros((5, 3), np.float32)), r"shape \[5, 3\].*If its rows are frames, say so"),
        (changed(obs=np.zeros((5, 1, 2, 3), np.float32)), r"without the axis of streams: obs\[:, 0\]"),
        (changed(obs=np.zeros((4, 2, 3), np.float32)), "observations differ in length"),
        (changed(obs=np.float32(1)), "observations differ in length"),
        (changed(obs=np.zeros((5, 2, 3), np.complex64)), "'obs' has dtype complex64; expected float32"),
        (changed(goal=np.zeros((5, 4), np.float32)), "'goal' has dtype float32; expected int64"),
        (changed(obs=NAN), "'obs' holds NaN or infinity in 1 rows, the first of them row 2"),
        (changed(obs=np.full((5, 2, 3), 1e300)), "'obs' holds NaN or infinity in 5 rows"),
        (changed(episode_ends=None), "has no array 'episode_ends'"),
        ({f"data/{i:03}": np.zeros(1) for i in range(200)}, r"it has data/000, .*, data/007, .. \(200 in all\). Add"),
        (changed(episode_ends=np.array([], np.int64)), "episode_ends is empty: no episode is complete"),
        (
            changed(episode_ends=np.array([2, 6])),
            "last episode ends at row 6, but there are 5 rows: no such episode is complete",
        ),
        (changed(episode_ends=np.array([3, 3, 5])), r"episode_ends is \[3, 3, 5\].*increasing"),
        (changed(episode_ends=np.array([0, 5])), r"episode_ends is \[0, 5\]"),
        (changed(episode_ends=np.array([-1, 5])), r"episode_ends is \[-1, 5\]"),
        (changed(episode_ends=np.array([2.0, 5.0])), r"episode_ends is float64\[2\]; expected integers"),
        (changed(meta=np.array("frames")), "expected 'meta' to be a JSON object"),
        (changed(meta=np.array('{"frames": 1}')), "frames of 'meta' is 1; expected true or false"),
        (changed(meta=np.array(3)), "expected 'meta' to be a JSON object"),
        (changed(meta=np.array("[" * 100_000)), "expected 'meta' to be a JSON object"),
        (changed(meta=np.array('{"frames": true}')), r"expected \[F, \*frame\] = \[.., 3\]"),
    ],
)
def test_what_does_not_fit_is_refused(file: Path, content: dict[str, Any], message: str) -> None:
    saved(file, **content)
    with pytest.raises(TrajectoryError, match=message) as error:
        load(file)
    assert str(file) in str(error.value)


def test_a_camera_that_was_not_recorded_may_be_left_out(file: Path) -> None:
    saved(file, **arrays())
    camera = ObservationSpec((1, 3, 8, 8), bounds=(0.0, 1.0))
    for spec, advised in ((camera, True), (ObservationSpec((1, 3)), False)):
        with pytest.raises(TrajectoryError, match="has no array 'wrist' for the observation 'wrist'") as error:
            load(file, {"wrist": spec})
        assert ("--without-camera wrist" in str(error.value)) == advised


def test_pickled_objects_are_never_loaded(file: Path, tmp_path: Path) -> None:
    target = tmp_path / "touched"
    content = {**arrays(), "obs": np.array([Runs(os.mkdir, str(target))] * 5, dtype=object)}
    np.savez(file, allow_pickle=True, **content)
    with pytest.raises(TrajectoryError, match="Python objects"):
        load(file)
    assert not target.exists()


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.9, -1])
def test_truncated_files_are_refused(file: Path, keep: float) -> None:
    saved(file, **arrays())
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    with pytest.raises(TrajectoryError, match="cannot be read as .npz|truncated"):
        load(file)


def test_changed_data_is_refused(file: Path) -> None:
    saved(file, **arrays())
    content = bytearray(file.read_bytes())
    at = content.index(b"obs.npy") + 200
    content[at] ^= 255
    file.write_bytes(bytes(content))
    with pytest.raises(TrajectoryError, match="cannot be read as .npz"):
        load(file)


def test_other_files_are_refused(tmp_path: Path) -> None:
    single = tmp_path / "one.npy"
    np.save(single, np.zeros(3))
    with pytest.raises(TrajectoryError, match=r"one\.npy: .*found a single one\. Use np\.savez"):
        load(single)
    cut = tmp_path / "cut.npz"
    np.savez(cut, obs=np.zeros(30))
    cut.write_bytes(cut.read_bytes()[:100])
    with pytest.raises(TrajectoryError, match="cannot be read as .npz .*truncated"):
        load(cut)
    archive = tmp_path / "archive.npz"
    with zipfile.ZipFile(archive, "w") as z:
        z.writestr("obs.npy", b"no array")
    with pytest.raises(TrajectoryError):
        load(archive)
    with pytest.raises(TrajectoryError, match="does not exist"):
        load(tmp_path / "none.npz")
    with pytest.raises(TrajectoryError, match="expected an .npz, a zarr replay buffer"):
        load(tmp_path)
    with pytest.raises(TrajectoryError, match="no trajectory files"):
        load_trajectories([], SPECS, 2)
    for paths in ([np.zeros(3)], np.ma.zeros((2, 3)), [None], None, 5):
        with pytest.raises(TrajectoryError, match=r"expected paths of recordings; found a \w+\. Use np.savez"):
            load_trajectories(paths, SPECS, 2)  # type: ignore[arg-type]


def test_numbers_that_a_call_would_refuse_are_refused_in_a_recording(file: Path) -> None:
    content = arrays()
    content["obs"][3, 1, 2] = -1e30
    with pytest.raises(
        TrajectoryError, match=r"npz: 'obs' must be between .* 1e\+06; found -1e\+30 at index \(3, 1, 2\)"
    ):
        load(saved(file, **content))
    content["obs"][3, 1, 2] = 2e6
    normalizer = Affine(np.array([1.0, 1.0, 0.4], np.float32), np.zeros(3, np.float32))
    specs = SPECS | {"obs": ObservationSpec((2, 3), normalizer)}
    assert load(saved(file, **content), specs)[1].observations["obs"][1, 1, 2] == 2e6
    specs |= {"goal": ObservationSpec((4,), dtype="int64", bounds=(0.0, 9.0))}
    with pytest.raises(TrajectoryError, match="npz: 'goal' must hold integers of 0 to 9; found 0 to 19"):
        load(saved(file, **content), specs)


def test_integers_that_would_wrap_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "calls.npz"
    specs = {"goal": ObservationSpec((2,), dtype="uint8")}
    np.savez(path, goal=np.array([[1, 2], [3, 300]]), episode_ends=np.array([2]))
    with pytest.raises(TrajectoryError, match="'goal' holds numbers that uint8 cannot"):
        load_trajectories([path], specs, 2)
    np.savez(path, goal=np.array([[1, 2], [3, 255]]), episode_ends=np.array([2]))
    (episode,) = load_trajectories([path], specs, 2)
    assert episode.observations["goal"].dtype == np.uint8
