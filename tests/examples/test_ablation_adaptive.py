"""Deciding on the way, on a small policy: what its schedules share, and what the script prints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import adaptive
import nested
import numpy as np
import pytest
from click.testing import CliRunner
from nested import Nested

from tests.calibration import policies
from ttscompile.errors import CalibrationError


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return policies.record(tmp_path_factory.mktemp("calls") / "calls.npz", 8)


@pytest.fixture(scope="module")
def found(compiled: Path, recording: Path) -> Nested:
    return nested.nested(compiled, [recording], (3.0,), most=4, fitted=12, learned=8, judged=8, minutes=0.001)


def test_three_parts_of_the_episodes_share_none(found: Nested) -> None:
    parts = [set(numbers) for numbers in found.episodes.values()]
    assert all(parts) and sum(map(len, parts)) == len(set.union(*parts)) == 8
    assert found.calls == (12, 8, 8)


def test_the_rows(found: Nested) -> None:
    assert set(found.fixed) == {2, 3, 4} and [row.most for row in found.rows] == [2, 3, 4]
    assert found.decided
    for each in found.decided:
        assert all(ending[0] == 0 and len(ending) <= 4 for ending in each.family.endings)
        assert all(np.isfinite([row.error, *row.tail]).all() and row.most <= 4 for row in each.rows)
        mixed, by_estimate, _, after = each.rows
        assert mixed.evaluations == by_estimate.evaluations >= after.evaluations - 1e-9
        assert by_estimate.gain is not None
        assert by_estimate.gain[0] == pytest.approx(1 - by_estimate.error / mixed.error)


def test_it_prints_a_table(found: Nested, compiled: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {}

    def measured(*given: Any, **named: Any) -> Nested:
        told.update(named, evaluations=given[2])
        return found

    monkeypatch.setattr(adaptive, "nested", measured)
    asked = [str(compiled), "--trajectories", str(recording), "--evaluations", "2.5", "--jumps", "--minutes", "2"]
    result = CliRunner().invoke(adaptive.main, asked, catch_exceptions=False)
    assert result.exit_code == 0
    assert told["evaluations"] == (2.5,) and told["jumps"] is True and told["minutes"] == 2
    printed = " ".join(result.stdout.split())
    assert "who decides" in printed and "everything, after the fact" in printed and "compares at 0, " in printed
    assert '"fixed"' in CliRunner().invoke(adaptive.main, [*asked, "--json"], catch_exceptions=False).stdout


def test_endings_begin_as_the_beginning_does() -> None:
    every = list(nested._continued(16, [(0, 5), (0, 9, 15)], 4))
    assert len(every) == len(set(every)) and all(one[:2] == (0, 5) and 3 <= len(one) <= 4 for one in every)
    assert all(list(one) == sorted(set(one)) and one[-1] < 16 for one in every)


def test_what_cannot_be_measured_is_refused(compiled: Path, recording: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="above 2 and below 6, the computed steps of a call at most; found 9"):
        nested.nested(compiled, [recording], (9.0,))
    few = tmp_path / "few.npz"
    np.savez(few, obs=np.linspace(0, 0.5, 36, dtype=np.float32).reshape(6, 2, 3), episode_ends=np.array([2, 4, 6]))
    with pytest.raises(CalibrationError, match="hold 3 episodes; expected four at least"):
        nested.nested(compiled, [few])
