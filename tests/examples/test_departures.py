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
    made = dict(departures.departures(values, rng, -values))
    assert made["3 times the range"].tolist() == [[-4, 2], [8, 2]]
    assert made["number 0 mirrored"].tolist() == [[4, 2], [0, 2]]
    assert made["columns reversed"].tolist() == [[2, 0], [2, 4]]
    assert made["constant: highest"].tolist() == [[4, 2], [4, 2]]
    assert made["another task"].tolist() == (-values).tolist()
