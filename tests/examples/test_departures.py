"""The table of departures: of a plan with a correction, which is left out far outside."""

import json
from pathlib import Path

import departures
import numpy as np
import pytest
from click.testing import CliRunner

from tests.plans import store_schedules
from tests.runtimes.plans import random_correction
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.core.envelope import Envelope
from ttscompile.core.lattice import uniform_plan


@pytest.fixture
def asked(tmp_path: Path) -> list[str]:
    """Words that name a small artifact with a correction and an envelope, and a recording."""
    artifact = written_artifact(toy_program(), tmp_path / "artifact")
    numbers, cells = artifact.manifest.condition_numbers, (artifact.manifest.steps, len(artifact.manifest.groups))
    correction, rng = random_correction(artifact, np.random.default_rng(0)), np.random.default_rng(1)
    envelope = Envelope((np.eye(numbers) / 4).astype(np.float32), np.zeros(numbers, np.float32))
    corrections, plan = {"fast": correction}, {"fast": uniform_plan(*cells, 2)}
    store_schedules(artifact.path, None, plan, "fast", {}, corrections=corrections, envelope=envelope)
    np.savez(tmp_path / "calls.npz", obs=rng.standard_normal((40, 2)).astype(np.float32), episode_ends=[20, 40])
    return [str(artifact.path), "--trajectories", str(tmp_path / "calls.npz"), "--calls", "6"]


def test_far_outside_a_plan_is_what_even_steps_are(asked: list[str]) -> None:
    result = CliRunner().invoke(departures.main, [*asked, "--json"], catch_exceptions=False)
    found = {one["departure"]: one for one in json.loads(result.stdout)}
    assert {"as recorded", "3 times the range", "random in the range", "columns reversed"} <= set(found)
    for one in found.values():
        if one["outside"] in (0, 1):
            assert one["distance"] == one["even" if one["outside"] else "unbounded"]
    assert found["as recorded"]["outside"] < 1 == found["times 100"]["outside"]
    table = CliRunner().invoke(departures.main, asked, catch_exceptions=False).stdout
    assert "30 times the range" in table and "even steps" in table and "another task" not in table


def test_the_worst_of_a_plan_and_another_task(asked: list[str], tmp_path: Path) -> None:
    """Exit status 1 where a plan is further than even steps by more than is allowed."""
    away = np.full((30, 2), 50, np.float32)
    np.savez(tmp_path / "other.npz", obs=away, episode_ends=[10, 30])
    asked += ["--other", str(tmp_path / "other.npz")]
    every = CliRunner().invoke(departures.main, [*asked, "--json"], catch_exceptions=False)
    found = [one for one in json.loads(every.stdout) if one["plan"] == "fast"]
    assert found[-1]["departure"] == "another task" and found[-1]["outside"] == 1
    assert found[-1]["distance"] == found[-1]["even"]
    worst = max(found, key=lambda one: one["distance"] - one["even"])
    short = CliRunner().invoke(departures.main, [*asked, "--summary"], catch_exceptions=False)
    (row,) = [line for line in short.stdout.splitlines() if line.startswith(" fast")]
    assert row.split()[1:4] == [
        f"{x:.2f}" for x in (found[0]["distance"], found[0]["even"], worst["distance"] - worst["even"])
    ]
    assert worst["departure"] in row
    assert every.exit_code == short.exit_code == int(worst["distance"] - worst["even"] > departures.ALLOWED)


def test_departures_by_hand() -> None:
    values, rng = np.array([[0.0, 2.0], [4.0, 2.0]], np.float32), np.random.default_rng(0)
    made = dict(departures.departures({"obs": values}, rng, {"obs": -values}))
    assert made["3 times the range"]["obs"].tolist() == [[-4, 2], [8, 2]]
    assert made["number 0 mirrored"]["obs"].tolist() == [[4, 2], [0, 2]]
    assert made["columns reversed"]["obs"].tolist() == [[2, 0], [2, 4]]
    assert made["constant: highest"]["obs"].tolist() == [[4, 2], [4, 2]]
    assert made["another task"]["obs"].tolist() == (-values).tolist()


def test_keys_of_different_widths_depart_together() -> None:
    """All have the departure of that name, and a number is mirrored in every key that has it."""
    rng = np.random.default_rng(0)
    values = {"pose": rng.random((5, 2), np.float32), "joints": rng.random((5, 1, 9), np.float32)}
    named = list(departures.departures(values, np.random.default_rng(1)))
    made = dict(named)
    assert len(made) == len(named) and all(list(changed) == list(values) for changed in made.values())
    assert [name for name in made if "mirrored" in name] == [f"number {n} mirrored" for n in (0, 1, 3, 6)]
    changed = {name: [key for key in values if (each[key] != values[key]).any()] for name, each in made.items()}
    assert changed["number 0 mirrored"] == changed["number 1 mirrored"] == ["pose", "joints"]
    assert changed["number 3 mirrored"] == changed["number 6 mirrored"] == ["joints"]
    for key, value in values.items():
        np.testing.assert_array_equal(made["times 100"][key], 100 * value)
        assert (made["constant: zeros"][key] == 0).all()


def test_of_another_task_there_may_be_fewer_calls(asked: list[str], tmp_path: Path) -> None:
    """Then as many of those that were recorded are compared."""
    away = np.linspace(40, 50, 8, dtype=np.float32).reshape(4, 2)
    np.savez(tmp_path / "other.npz", obs=away, episode_ends=[2, 4])
    words = [*asked, "--other", str(tmp_path / "other.npz"), "--json"]
    fewer = json.loads(CliRunner().invoke(departures.main, words, catch_exceptions=False).stdout)
    four = json.loads(CliRunner().invoke(departures.main, [*asked[:-1], "4", "--json"], catch_exceptions=False).stdout)
    assert fewer[-1]["departure"] == "another task" and fewer[: len(four)] == four


def test_a_plan_that_goes_too_far_is_named(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """On standard error, with the place; the exit status is 1."""
    monkeypatch.setattr(departures, "ALLOWED", -2.0)  # even as near as even steps is too far
    result = CliRunner().invoke(departures.main, [*asked, "--json"], catch_exceptions=False)
    worst = max(json.loads(result.stdout), key=lambda one: one["distance"] - one["even"])
    assert result.exit_code == 1
    assert result.stderr.startswith("plan 'fast' is ") and result.stderr.endswith(f"at: {worst['departure']}\n")
    assert f"{worst['distance'] - worst['even']:.2f} of other noise further" in result.stderr


@pytest.mark.parametrize("words", [[], ["--plan", "dense"]])
def test_plans_without_a_correction_are_refused(words: list[str], tmp_path: Path) -> None:
    artifact = written_artifact(toy_program(), tmp_path / "artifact")
    np.savez(tmp_path / "calls.npz", obs=np.zeros((4, 2), np.float32), episode_ends=[4])
    given = [str(artifact.path), "--trajectories", str(tmp_path / "calls.npz"), *words]
    result = CliRunner().invoke(departures.main, given)
    assert result.exit_code == 2 and "expected plans with a correction" in result.stderr
    assert ("plan 'dense' has none" in result.stderr) == bool(words)
    assert "'ttscompile build' makes such plans" in " ".join(result.stderr.split())
