"""The oracle on a small policy: which episodes, schedules and calls it takes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import foresight
import numpy as np
import pytest
from choosing import AFTER, OBSERVATION, SINGLE
from foresight import Oracle, oracle, placements

from tests.calibration import policies
from ttscompile.artifact.load import load_artifact
from ttscompile.errors import CalibrationError


@pytest.fixture(scope="module")
def found(compiled: Path, recording: Path) -> Oracle:
    return oracle(compiled, [recording], 3, schedules=4, calls=12, draws=2)


@pytest.mark.slow
def test_three_parts_of_the_episodes_share_none(found: Oracle) -> None:
    parts = [set(numbers) for numbers in found.episodes.values()]
    assert all(parts) and sum(map(len, parts)) == len(set.union(*parts))


@pytest.mark.slow
def test_the_rows(found: Oracle) -> None:
    rows = {one.name: one for one in found.choices}
    known = ["the observation", "the noise", "the sample after step 0", "all of these"]
    average = [f"{AFTER}; 3 steps on average", "all of these; 3 steps on average"]
    assert list(rows) == [SINGLE, AFTER, OBSERVATION, *known, *average]
    assert found.schedules == {2: 4, 3: 4, 4: 4}
    assert found.calls[1] == 2
    assert all(np.isfinite([one.error, one.gain, *one.interval]).all() for one in found.choices)
    assert 0 < rows[AFTER].error <= min(one.error for one in found.choices[:7])
    assert all(rows[name].steps == 3 for name in (SINGLE, AFTER, OBSERVATION, *known))
    assert rows[average[0]].steps <= 3 and rows[average[0]].error <= rows[AFTER].error


@pytest.mark.slow
def test_the_same_arguments_give_the_same_figures(found: Oracle, compiled: Path, recording: Path) -> None:
    assert oracle(compiled, [recording], 3, schedules=4, calls=12, draws=2) == found


def test_placements() -> None:
    assert placements(5, 2, 16, 0) == [(0, 1), (0, 2), (0, 3), (0, 4)]
    some = placements(16, 4, 12, 0)
    assert len(some) == len(set(some)) == 12
    assert all(one[0] == 0 and list(one) == sorted(set(one)) and one[-1] < 16 and len(one) == 4 for one in some)
    assert placements(16, 1, 16, 0) == [(0,)]
    assert some != placements(16, 4, 12, 1)


def test_what_cannot_be_measured_is_refused(compiled: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match=f"between 2 and {policies.STEPS - 1} of {policies.STEPS}; found 10"):
        oracle(compiled, [recording], policies.STEPS)
    with pytest.raises(CalibrationError, match="draws"):
        oracle(compiled, [recording], 3, draws=1)


def test_two_episodes_are_too_few(compiled: Path, tmp_path: Path) -> None:
    few = tmp_path / "few.npz"
    np.savez(
        few,
        obs=np.zeros((4, 2, 3), np.float32) + np.float32(0.1) * np.arange(4)[:, None, None].astype(np.float32),
        episode_ends=np.array([2, 4]),
    )
    with pytest.raises(CalibrationError, match="hold 2 episodes; expected three at least"):
        oracle(compiled, [few], 3)


def test_of_one_step_nothing_can_be_chosen(compiled: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_artifact(compiled)
    sampler = loaded.manifest.spec.sampler
    rows: Any = {name: np.ascontiguousarray(getattr(sampler, name)[:1]) for name in sampler.COLUMNS}
    one = replace(sampler, timesteps=sampler.timesteps[:1].copy(), **rows)
    single = replace(loaded, manifest=replace(loaded.manifest, spec=replace(loaded.manifest.spec, sampler=one)))
    monkeypatch.setattr(foresight, "load_artifact", lambda _: single)
    with pytest.raises(CalibrationError, match="1 denoising step; expected three at least"):
        oracle(compiled, [recording], 2)
