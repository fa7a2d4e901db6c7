"""The table of departures: of a plan with a correction, which is left out far outside."""

import json
from pathlib import Path

import departures
import numpy as np
from click.testing import CliRunner

from tests.plans import store_schedules
from tests.runtimes.plans import random_correction
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.core.envelope import Envelope
from ttscompile.core.lattice import uniform_plan


def test_far_outside_a_plan_is_what_even_steps_are(tmp_path: Path) -> None:
    artifact = written_artifact(toy_program(), tmp_path / "artifact")
    numbers, cells = artifact.manifest.condition_numbers, (artifact.manifest.steps, len(artifact.manifest.groups))
    correction, rng = random_correction(artifact, np.random.default_rng(0)), np.random.default_rng(1)
    envelope = Envelope((np.eye(numbers) / 4).astype(np.float32), np.zeros(numbers, np.float32))
    corrections, plan = {"fast": correction}, {"fast": uniform_plan(*cells, 2)}
    store_schedules(artifact.path, None, plan, "fast", {}, corrections=corrections, envelope=envelope)
    np.savez(tmp_path / "calls.npz", obs=rng.standard_normal((40, 2)).astype(np.float32), episode_ends=[20, 40])
    asked = [str(artifact.path), "--trajectories", str(tmp_path / "calls.npz"), "--calls", "6"]
    result = CliRunner().invoke(departures.main, [*asked, "--json"], catch_exceptions=False)
    found = {one["departure"]: one for one in json.loads(result.stdout)}
    assert {"as recorded", "3 times the range", "random in the range", "columns reversed"} <= set(found)
    for one in found.values():
        if one["outside"] in (0, 1):
            assert one["distance"] == one["even" if one["outside"] else "unbounded"]
    assert found["as recorded"]["outside"] < 1 == found["times 100"]["outside"]
    table = CliRunner().invoke(departures.main, asked, catch_exceptions=False).stdout
    assert "30 times the range" in table and "even steps" in table
