"""At which rate recordings were made: what is read of it, and where it goes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.calibration import policies
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import recorded_rate


def recorded(path: Path, **meta: Any) -> Path:
    made = policies.record(path)
    np.savez(made, **np.load(made), meta=np.array(json.dumps(meta)))
    return made


def data_set(path: Path, **info: Any) -> Path:
    (path / "meta").mkdir(parents=True)
    (path / "meta" / "info.json").write_text(json.dumps(info))
    return path


def test_a_file_says_it_in_its_meta_and_a_data_set_as_its_frames_a_second(tmp_path: Path) -> None:
    said = recorded(tmp_path / "said.npz", policy_hz=10)
    silent = policies.record(tmp_path / "silent.npz")
    of_lerobot = data_set(tmp_path / "set", fps=10)
    assert recorded_rate(said.rename(tmp_path / "said.NPZ")) == 10.0, "whatever it is called"
    said = (tmp_path / "said.NPZ").rename(said)
    assert recorded_rate(said) == recorded_rate([silent, said]) == recorded_rate([of_lerobot, str(said)]) == 10.0
    assert recorded_rate([silent]) is None and recorded_rate([data_set(tmp_path / "other")]) is None


def test_recordings_of_two_rates_say_none(tmp_path: Path) -> None:
    paths = [recorded(tmp_path / "said.npz", policy_hz=12.5), data_set(tmp_path / "set", fps=30)]
    with pytest.warns(UserWarning, match="the recordings are of 12.5 and 30 Hz, so the policy's rate is not known"):
        assert recorded_rate(paths) is None


@pytest.mark.parametrize("rate", [0, -1, "10", True, [10], 1e9])
def test_what_is_no_rate_is_refused_by_name(rate: object, tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"said.npz: policy_hz is .*; expected frames and actions a second\."):
        recorded_rate([recorded(tmp_path / "said.npz", policy_hz=rate)])
    with pytest.raises(TrajectoryError, match=r"set: fps is .*; expected frames and actions a second\."):
        recorded_rate([data_set(tmp_path / "set", fps=rate)])
