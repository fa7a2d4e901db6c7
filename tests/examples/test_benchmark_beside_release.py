"""An artifact of another version beside one of this: here the same version is both."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from beside_release import beside, main
from click.testing import CliRunner

from tests.runtimes.plans import random_correction
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import FULL


@pytest.fixture(scope="module")
def calibrated(four_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a plan of two of four steps, and a correction."""
    path = Path(shutil.copytree(four_steps, tmp_path_factory.mktemp("calibrated") / "before"))
    artifact = load_artifact(path)
    full = artifact.plans[FULL]
    blocks = len(artifact.manifest.blocks)
    correction = random_correction(view_of(artifact, full), np.random.default_rng(0))
    plan = replace(full, cells=uniform_plan(4, blocks, 2), correction=correction, repair=True)
    update_plans(path, {**artifact.plans, "schedule": plan}, "schedule")
    return path


@pytest.mark.slow
def test_the_plan_is_moved_and_no_bit_differs(calibrated: Path, four_steps: Path) -> None:
    result = CliRunner().invoke(main, [sys.executable, str(calibrated), str(four_steps), "--rounds", "2", "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert [(row["plan"], row["difference"]) for row in told["rows"]] == [("dense", 0.0), ("schedule", 0.0)]
    assert all(row["ratio"][0] > 0 and row["ms"] > 0 and row["mib"][0] > 10 for row in told["rows"])
    assert set(told["loads"]) == {"before", "now"}


@pytest.mark.slow
def test_another_plan_is_seen(calibrated: Path, four_steps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import beside_release

    made = beside_release.with_plan_of

    def uncorrected(other: Path, artifact: Path, into: Path) -> None:
        made(other, artifact, into)
        plans = load_artifact(into).plans
        update_plans(into, {**plans, "schedule": replace(plans["schedule"], correction=None)}, "schedule")

    monkeypatch.setattr(beside_release, "with_plan_of", uncorrected)
    rows, _ = beside(sys.executable, calibrated, four_steps, rounds=1)
    assert rows[0].difference == 0 < rows[1].difference


@pytest.mark.slow
def test_what_was_not_calibrated_is_refused(four_steps: Path) -> None:
    with pytest.raises(click.ClickException, match="its default plan is 'full'. Calibrate it first"):
        beside(sys.executable, four_steps, four_steps, rounds=1)
