"""From a checkpoint to a chosen plan, in one call and in one command."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.calibration import policies
from tests.once import Once
from ttscompile import builder
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.calibration.state import FILE as STATE
from ttscompile.cli import main
from ttscompile.errors import CalibrationError, CalibrationFailedError


@pytest.fixture
def directory(once: Once, tmp_path: Path) -> Path:
    """An artifact of ten steps, of which actions 1 to 4 of 8 are executed."""
    return shutil.copytree(policies.compiled(once), tmp_path / "compiled")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, directory: Path) -> dict[str, Any]:
    """What ``convert`` and ``calibrate`` are called with; neither does anything, and an artifact is there."""
    found: dict[str, Any] = {}

    def convert(checkpoint: object, directory: object, **how: Any) -> None:
        found["convert"] = {"checkpoint": checkpoint, "directory": directory, **how}

    def calibrate(directory: object, trajectories: object, **how: Any) -> None:
        found["calibrate"] = {"directory": directory, "trajectories": trajectories, **how}

    monkeypatch.setattr(builder, "convert", convert)
    monkeypatch.setattr(builder, "calibrate", calibrate)
    return found


def test_what_applies_is_learned_and_a_control_loop_is_a_deadline(asked: dict[str, Any], directory: Path) -> None:
    ttscompile.build("policy.ckpt", directory, ["calls.npz"], control_hz=50, task="push", progress=False)
    assert asked["convert"]["task"] == "push" and asked["convert"]["precision"] == "int8"
    assert asked["convert"]["prediction_horizon"] == "needed"
    assert ("dpmsolver++", 16) in asked["convert"]["loops"]
    # The toy has neither another precision nor an image encoder.
    assert asked["calibrate"]["learn"] == ["loops"]
    info = ttscompile.load(directory).info
    executed = info.action.stop - info.action.start
    predicted = info.sample[0] - info.action.start
    # A chunk lasts for two calls, the wait for a frame and a tick; and a call takes no longer than what is executed.
    expected = 1e3 * min(executed / 50, (predicted - 2) / 50 / 2)
    assert asked["calibrate"]["latency_ms"] == pytest.approx(expected)


def test_two_deadlines_are_refused_before_anything_is_done(asked: dict[str, Any], directory: Path) -> None:
    with pytest.raises(CalibrationError, match="found latency_ms and control_hz"):
        ttscompile.build("policy.ckpt", directory, ["calls.npz"], control_hz=50, latency_ms=3)
    assert not asked


def test_a_loop_that_no_call_keeps_up_with_says_what_to_give(
    asked: dict[str, Any], directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = SimpleNamespace(feasibility=lambda latency: SimpleNamespace(max_latency=0.0))
    monkeypatch.setattr(builder, "resolve", lambda settings, info, control_hz: none)
    with pytest.raises(CalibrationFailedError, match="control loop of 50 Hz: .* --policy-hz"):
        ttscompile.build("policy.ckpt", directory, ["calls.npz"], control_hz=50)
    assert "calibrate" not in asked


def test_every_option_of_the_command_reaches_the_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[dict[str, Any]] = []

    def build(checkpoint: object, directory: object, trajectories: object, **how: Any) -> None:
        calls.append({"checkpoint": checkpoint, "directory": directory, "trajectories": trajectories, **how})
        raise CalibrationFailedError("no plan is near enough")

    monkeypatch.setattr("ttscompile.build", build, raising=False)
    checkpoint, recording = tmp_path / "policy.ckpt", tmp_path / "calls.npz"
    checkpoint.touch()
    recording.touch()
    words = ["build", str(checkpoint), "-t", str(recording), "-o", str(tmp_path / "out")]
    more = ["--latency-ms", "8", "--error", "0.1", "--threads", "2", "--minutes", "5", "--resume"]
    result = CliRunner().invoke(main, [*words, *more])
    assert result.exit_code == 1 and "no plan is near enough" in result.stderr
    (found,) = calls
    known = {"latency_ms": 8.0, "max_distance": 0.1, "threads": 2, "max_minutes": 5.0, "resume": True}
    assert known.items() <= found.items()
    options = {one.name for one in main.commands["build"].params if isinstance(one, click.Option)}
    taken = {"trajectories", "directory", "sources", "error", "minutes", "as_json"}
    assert options - taken <= set(found)


@pytest.mark.slow
def test_a_checkpoint_becomes_a_policy(one_layer_checkpoint: Path, tmp_path: Path) -> None:
    """The whole command, on one layer of the Push-T policy; and what it says is what it wrote."""
    draw = np.random.default_rng(0)
    walks = np.cumsum(draw.normal(0, 4, (24, 1, 20)), 0) + draw.uniform(200, 300, (24, 1, 20))
    recording = tmp_path / "calls.npz"
    np.savez(recording, obs=np.repeat(walks, 2, 1).astype(np.float32), episode_ends=[6, 12, 18, 24])
    words = ["build", str(one_layer_checkpoint), "-t", str(recording), "-o", str(tmp_path / "compiled")]
    result = CliRunner().invoke(main, [*words, "--minutes", "0.05", "--error", "3"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    artifact = load_artifact(tmp_path / "compiled")
    record = artifact.manifest.calibration
    assert record is not None and artifact.manifest.default_plan == "schedule"
    assert set(artifact.manifest.spec.loops) == {"dpmsolver++-16", "ddim-16"}
    assert artifact.manifest.spec.sample[0] == 13, "four of the sixteen actions are needed by nobody"
    (chosen,) = (row for row in record["frontier"] if row["name"] == "schedule")
    told = f"Chosen among {len(record['frontier'])} plans: {chosen['told']}"
    assert told in " ".join(result.output.split())
    assert not (tmp_path / "compiled" / STATE).exists()


def test_a_build_of_another_checkpoint_is_not_resumed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, directory: Path
) -> None:
    def converting(seed: int) -> None:
        def convert(_: object, path: Path, **how: Any) -> None:
            ttscompile.compile_denoiser(policies.Mixer(seed).eval(), policies.spec(), path)

        monkeypatch.setattr(builder, "convert", convert)

    before = read_manifest(directory).model_identity
    (directory / STATE).touch()
    monkeypatch.setattr(builder, "calibrate", lambda *_, **__: None)
    converting(seed=0)
    ttscompile.build("policy.ckpt", directory, ["calls.npz"], resume=True)
    converting(seed=1)
    with pytest.raises(CalibrationError, match="found another model. Leave --resume out"):
        ttscompile.build("other.ckpt", directory, ["calls.npz"], resume=True)
    assert read_manifest(directory).model_identity == before
    assert [path.name for path in tmp_path.iterdir()] == ["compiled"], "nothing is left beside it"
