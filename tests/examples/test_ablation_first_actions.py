"""What is known of a chunk on the way: by position, of the whole loop and of a plan, and that maps are found."""

from __future__ import annotations

import json
from pathlib import Path

import first_actions
import numpy as np
import pytest
from click.testing import CliRunner

from tests.calibration import policies
from ttscompile.errors import CalibrationError


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return policies.record(tmp_path_factory.mktemp("calls") / "calls.npz", 8)


def test_what_is_linear_is_fitted() -> None:
    given = np.random.default_rng(0)
    known, asked = given.normal(size=(400, 3)), given.normal(size=(5, 3))
    matrix = np.array([[1.0, 0.0], [2.0, -1.0], [0.0, 0.5]])
    np.testing.assert_allclose(first_actions._fitted(known, known @ matrix + 3, asked), asked @ matrix + 3, atol=0.02)


@pytest.mark.slow
def test_both_loops_are_told_of_and_the_last_evaluation_knows_all(planned: Path, calls: Path) -> None:
    asked = [str(planned), "--trajectories", str(calls), "--fitted", "24", "--judged", "8"]
    result = CliRunner().invoke(first_actions.main, [*asked, "--json"], catch_exceptions=False)
    assert result.exit_code == 0
    rows = json.loads(result.stdout)["rows"]
    assert [len(row["distances"]) for row in rows] == [4] * len(rows), "as many as are executed"
    found = {(row["loop"], *row["evaluations"], row["estimate"]): np.array(row["distances"]) for row in rows}
    steps = [(loop, i, count) for loop, count in (("whole", 10), ("plan", 5)) for i in range(1, count + 1)]
    expected = {(*each, estimate) for each in steps for estimate in ("clean", "fitted")}
    assert set(found) == expected | {
        ("", 0, 10, "other noise"),
        ("whole", 10, 10, "the end"),
        ("plan", 5, 5, "the end"),
    }
    np.testing.assert_array_equal(found["whole", 10, 10, "the end"], 0)
    assert (found["plan", 5, 5, "the end"] > 0).all()
    np.testing.assert_allclose(found["plan", 1, 5, "clean"], found["whole", 1, 10, "clean"])
    assert all(np.isfinite(each).all() and (each >= 0).all() for each in found.values())
    printed = CliRunner().invoke(first_actions.main, asked, catch_exceptions=False).stdout
    assert "action 4" in printed and "3 of 5" in printed


def test_a_plan_without_cells_in_that_loop_is_refused(
    compiled: Path, calls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_actions, "base_of", lambda artifact: _Other())
    with pytest.raises(CalibrationError, match="no schedule in the loop 'other'"):
        first_actions.first_actions(compiled, [calls])


class _Other:
    """A plan of another loop."""

    loop, weights, exact = "other", "original", property(lambda self: self)
