"""Budgets at equal milliseconds: the largest that keeps a pace, what is found at it, and why nothing is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import equal_time
import pytest
from click.testing import CliRunner
from equal_time import SLACK, TRIES, Pace, largest
from rivals import main

from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import judge
from ttscompile.calibration.budget import Goal
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan


@pytest.fixture(scope="module")
def arguments(compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a copy, since a search keeps its state in the artifact's folder."""
    copy = shutil.copytree(compiled, tmp_path_factory.mktemp("paced") / "compiled")
    return [str(copy), "-t", str(recording), "--calls", "2"]


def test_the_largest_budget_is_near_where_a_line_keeps_the_pace() -> None:
    asked = list[int]()

    def line(cells: int) -> float:
        asked.append(cells)
        return 0.5 + cells / 100

    budget, tried = largest(line, 6, 90, 3)
    assert budget is not None
    assert abs(line(budget) - 1) <= SLACK
    assert asked[0] == 90
    assert tried == {cells: 0.5 + cells / 100 for cells in asked}
    assert len(tried) <= TRIES
    assert largest(lambda cells: 1 + SLACK, 6, 90, 3) == (90, {90: 1 + SLACK})  # as fast as whole steps


def test_what_no_budget_keeps_is_none() -> None:
    budget, tried = largest(lambda cells: 2.0, 6, 90, 3)
    assert budget is None
    assert min(tried) == 6
    assert largest(lambda cells: float("inf") if cells > 10 else 1.0, 6, 90, 3)[0] == 6
    assert largest(lambda cells: 3.0, 6, 6, 3) == (None, {6: 3.0})


@pytest.mark.slow
def test_a_proposer_gets_the_cells_with_which_it_keeps_the_pace(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if a cell took as long as a fifth of a step of six cells takes."""

    def share(self: Pace, plan: Plan) -> float:
        assert plan.cells is not None
        return float((plan.cells == Source.COMPUTE).sum() / 5 / self.steps)

    monkeypatch.setattr(Pace, "share", share)
    asked = [*arguments, "--learn", "bac,l2c", "--even-steps", "3", "--correct", "--learned-calls", "32"]
    result = CliRunner().invoke(main, [*asked, "--json", "--into", str(tmp_path / "found")])
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    told, shares = document["comparison"], document["shares"]
    assert set(shares) == {"bac", "bac, corrected"}
    assert all(0.8 <= shares[series]["as-3"] <= 1 + SLACK for series in shares)
    assert [(one["series"], one["name"]) for one in told["points"][1:]] == [("bac", "as-3"), ("bac, corrected", "as-3")]
    assert "computes at least 30 of the 10 x 6 cells" in told["skipped"]["l2c as-3"]
    cells = load_artifact(tmp_path / "found").plans["bac-as-3"].cells
    assert cells is not None
    assert 12 <= (cells == Source.COMPUTE).sum() <= 15


@pytest.mark.slow
def test_milliseconds_become_as_many_steps_as_they_have_room_for(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(trials: Any, goal: Goal, pruned: bool) -> Goal:
        assert (goal.value, goal.threads) == (7.5, 1)
        return Goal(goal.kind, goal.value, 1, 4 * 6)

    monkeypatch.setattr(equal_time, "measure_budget", measured)
    monkeypatch.setattr(Pace, "share", lambda self, plan: 1.0 if self.steps == 4 else 2.0)
    result = CliRunner().invoke(main, [*arguments, "--learn", "interval", "--latency-ms", "7.5", "--json"])
    assert result.exit_code == 0, result.stderr
    (point,) = json.loads(result.stdout)["comparison"]["points"][1:]
    assert (point["name"], point["sparsity"]) == ("7.5ms", 0.6)


def test_a_plan_is_timed_beside_even_steps(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What reuses nine of ten steps, beside one whole step."""
    timed = list[list[int]]()
    monkeypatch.setattr(equal_time, "SECONDS", 0.01)

    def counting(given: Any, threads: int, rounds: int) -> Any:
        timed.append([int((plan.cells == Source.COMPUTE).sum()) for _, plan in given])
        return judge.timed(given, threads, rounds)

    monkeypatch.setattr(equal_time, "timed", counting)
    asked = [*arguments, "--learn", "interval", "--even-steps", "1", "--json"]
    result = CliRunner().invoke(main, asked)
    assert result.exit_code == 0, result.stderr
    assert timed[0] == [6, 6]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--latency-ms", "x"], "could not convert"),
        (["--even-steps", "0"], "expected positive whole numbers"),
        (["--even-steps", "10"], "10 of 10 steps are all there are"),
        (["--even-steps", "2", "--sparsities", "0.5"], "give either sparsities or a time"),
    ],
)
def test_what_means_nothing_is_refused(arguments: list[str], options: list[str], message: str) -> None:
    result = CliRunner().invoke(main, [*arguments, *options])
    assert result.exit_code == 2
    assert message in result.stderr
