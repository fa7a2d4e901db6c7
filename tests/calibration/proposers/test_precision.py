"""Calibration of an artifact in eight bits: the plan's error and the precision's are told apart."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.pipeline import calibrate

from . import policies


@pytest.fixture
def int8(once: Once, tmp_path: Path) -> Path:
    return Path(shutil.copytree(policies.compiled(once, "int8"), tmp_path / "compiled"))


def test_the_error_of_the_precision_has_figures_of_its_own(int8: Path, compiled: Path, recording: Path) -> None:
    before = load_artifact(int8).manifest
    arguments = {"target_sparsity": 0.7, "strategy": "interval", "max_intervals": 1, "progress": False}
    result = calibrate(int8, [recording], **arguments)
    manifest = load_artifact(int8).manifest
    assert manifest.precision == before.precision
    assert manifest.calibration is not None
    record = manifest.calibration["precision"]
    assert (record["name"], record["calls"]) == ("int8", 8)
    assert list(record["plans"]) == ["dense", "schedule"]
    assert record["parts"] == {"blocks": record["plans"]["dense"]["error"]}
    assert before.precision is not None and before.precision.error is not None
    for score in record["plans"].values():
        assert 0 < score["error"] <= score["error_p90"] < 5 * before.precision.error.largest
        assert score["error"] < 0.5 * result.plans["schedule"].error


def test_an_artifact_in_fp32_has_none(artifact: Path, recording: Path) -> None:
    calibrate(artifact, [recording], 0.7, "interval", max_intervals=1, progress=False)
    record = load_artifact(artifact).manifest.calibration
    assert record is not None and "precision" not in record
