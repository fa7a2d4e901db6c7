"""Recordings that do not fit a policy: what the doctor says of names, pictures, ranges and rate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ttscompile import Affine, ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.core.finding import Finding, Level
from ttscompile.trajectories.fits import Placed, examine_recordings

from ..calibration import policies

LOW, HIGH = np.array([0, 10, -3, 100.0]), np.array([1, 20, -2, 101.0])
FRONT, WRIST, STATE = "observation.images.front", "observation.images.wrist", "observation.state"


def policy(**changes: Any) -> PolicySpec:
    """State of four numbers, and two cameras."""
    picture = ObservationSpec((2, 3, 4, 5), bounds=(0.0, 1.0))
    state = ObservationSpec((2, 4), bounds=(tuple(LOW), tuple(HIGH)))
    specs = {STATE: state, FRONT: picture, WRIST: picture} | changes
    return PolicySpec((8, 2), specs, policies.spec().sampler, ChunkSpec(2, 1, 5))


def pictures(mean: float) -> np.ndarray:
    return (255 * np.clip(np.random.default_rng(3).normal(mean, 0.05, (40, 4, 5, 3)), 0, 1)).astype(np.uint8)


def states() -> np.ndarray:
    return np.random.default_rng(0).uniform(LOW, HIGH, (40, 4)).astype(np.float32)


def examined(tmp_path: Path, **arrays: Any) -> dict[str, Finding]:
    """What is said of 40 frames, by what; None takes an array out."""
    arrays = {STATE: states(), FRONT: pictures(0.2), WRIST: pictures(0.7)} | arrays
    held = {key: array for key, array in arrays.items() if array is not None}
    meta = np.array('{"frames": true}')
    np.savez(tmp_path / "calls.npz", meta=meta, episode_ends=np.array([20, 40]), **held)
    return {one.what: one for one in examine_recordings([tmp_path / "calls.npz"], policy(), {})}


def test_what_fits_has_no_warning(tmp_path: Path) -> None:
    found = examined(tmp_path)
    assert {one.level for one in found.values()} == {Level.OK}
    assert found["calls"].found == "10 in 2 episodes"


def test_other_names_of_cameras_are_mapped_and_the_rest_is_tried_so(tmp_path: Path) -> None:
    names = {"observation.images.front_cam": pictures(0.2), "observation.images.hand": pictures(0.7)}
    found = examined(tmp_path, **{FRONT: None, WRIST: None}, **names)
    one = found["calls.npz"]
    assert one.level is Level.PROBLEM and f"lacks {FRONT}, {WRIST}" in one.found
    assert f"--observation {FRONT}=observation.images.front_cam" in one.remedy
    assert f"--observation {WRIST}=observation.images.hand" in one.remedy
    assert found["calls"].level is Level.OK


def test_two_names_that_could_be_either_are_not_guessed(tmp_path: Path) -> None:
    names = {"observation.images.a": pictures(0.2), "observation.images.b": pictures(0.7)}
    found = examined(tmp_path, **{FRONT: None, WRIST: None}, **names)
    assert "--without-camera" in found["calls.npz"].remedy
    assert found["load"].level is Level.PROBLEM


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    assert "not read: depth" in examined(tmp_path, depth=states())["calls.npz"].found


def test_permuted_columns_are_told_from_another_unit(tmp_path: Path) -> None:
    one = examined(tmp_path, **{STATE: states()[:, [1, 2, 0, 3]]})[f"range of {STATE!r}"]
    assert one.level is Level.PROBLEM and "75%" in one.found
    assert "column 0 is as 1 was, column 1 is as 2 was, column 2 is as 0 was" in one.found
    one = examined(tmp_path, **{STATE: np.degrees(states())})[f"range of {STATE!r}"]
    assert one.level is Level.PROBLEM and "permuted" not in one.remedy
    assert "degrees, radians" in one.remedy and "statistics are of another data set" in one.remedy


def test_a_hundredth_of_the_range_is_a_warning(tmp_path: Path) -> None:
    middle = (LOW + HIGH) / 2
    one = examined(tmp_path, **{STATE: (middle + np.radians(states() - middle)).astype(np.float32)})
    assert one[f"range of {STATE!r}"].level is Level.WARNING
    assert "degrees, radians" in one[f"range of {STATE!r}"].remedy


def test_a_column_without_a_place_of_its_own_is_not_called_permuted() -> None:
    seen = Affine(np.array([2, 2, 2], np.float32), np.array([-1, -1, -21], np.float32))  # 0..1, 0..1, 10..11
    values = np.tile(np.array([[10.5, 10.6, 0.5]], np.float32), (9, 1))
    assert Placed("obs", values, seen, 0.02).in_place_of() == {}
    assert Placed("obs", values[:, [2, 2, 0]], seen, 0.02).in_place_of() == {}, "nothing is outside"


def test_pictures_of_another_size_may_be_another_cameras(tmp_path: Path) -> None:
    one = examined(tmp_path, **{WRIST: pictures(0.5)[:, :3]})["load"]
    assert one.level is Level.PROBLEM and one.found.endswith("Is it another camera's?")


def test_channels_that_are_last_in_calls_are_said(tmp_path: Path) -> None:
    path = tmp_path / "calls.npz"
    arrays: dict[str, Any] = {key: np.zeros((6, 2, 4, 5, 3), np.float32) for key in (FRONT, WRIST)}
    arrays[STATE] = np.zeros((6, 2, 4), np.float32)
    np.savez(path, episode_ends=np.array([3, 6]), **arrays)
    (one,) = [each for each in examine_recordings([path], policy(), {}) if each.what == "load"]
    assert one.level is Level.PROBLEM and "np.moveaxis(image, -1, -3)" in one.found


@pytest.mark.parametrize(("rate", "level"), [(10, Level.OK), (1, Level.WARNING)])
def test_the_rate_of_a_data_set_says_how_long_nothing_is_seen(tmp_path: Path, rate: int, level: Level) -> None:
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps({"fps": rate, "features": {}}))
    from ttscompile.trajectories.fits import _rate

    (one,) = _rate(tmp_path / "set", policy())
    assert one.level is level and f"4 steps are executed in {4 / rate:.2g} s" in one.found


def test_tokens_of_an_instruction_are_not_missed(tmp_path: Path) -> None:
    tokens = {f"observation.language.{name}": ObservationSpec((8,), dtype="int64") for name in ("tokens", "mask")}
    spec = policy(**tokens)
    arrays = {STATE: states(), FRONT: pictures(0.2), WRIST: pictures(0.8), "episode_ends": np.array([20, 40])}
    np.savez(tmp_path / "frames.npz", meta=json.dumps({"frames": True}), **arrays)  # type: ignore[arg-type]
    found = {one.what: one for one in examine_recordings([tmp_path / "frames.npz"], spec, {})}
    assert found["instruction"].level is Level.NOTE and "convert --task" in found["instruction"].found
    assert not [one for one in found.values() if one.level is Level.PROBLEM]
    assert found["calls"].found == "10 in 2 episodes"
