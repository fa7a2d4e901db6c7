"""Calibration from end to end on a small policy: what it promises, and what it refuses."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.artifact.folders import contents
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import split_episodes
from ttscompile.calibration.pipeline import CalibrationResult, calibrate
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.state import FILE
from ttscompile.calibration.trials import DRAWS
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError
from ttscompile.rivals import bac, static

from . import policies
from .killed import killed

INTERVALS = 6
TARGET = 0.7


def quick(artifact: Path, recording: Path, **changes: Any) -> CalibrationResult:
    arguments: dict[str, Any] = {"target_sparsity": TARGET, "max_intervals": INTERVALS, "progress": False, **changes}
    return calibrate(artifact, [recording], **arguments)


@pytest.fixture(scope="module")
def calibrated(
    compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CalibrationResult]:
    """A calibrated artifact and the result; not to be changed."""
    directory = Path(shutil.copytree(compiled, tmp_path_factory.mktemp("calibrated") / "compiled"))
    return directory, quick(directory, recording, max_intervals=None)


@pytest.mark.slow
def test_the_plan_reaches_the_target_and_beats_the_uniform_schedule(calibrated: tuple[Path, CalibrationResult]) -> None:
    directory, result = calibrated
    artifact = load_artifact(directory)
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)
    budget = int((1 - TARGET) * steps * blocks + 1e-6)
    schedule = artifact.plans["schedule"].cells
    assert np.count_nonzero(schedule == Source.COMPUTE) == budget
    assert schedule is not None and (schedule[0] == Source.COMPUTE).all()
    np.testing.assert_array_equal(artifact.plans["uniform"].cells, uniform_plan(steps, blocks, 3))
    assert result.sparsity >= TARGET
    assert result.plans["uniform"].sparsity == pytest.approx(TARGET)
    error = policies.errors(result)
    assert error["schedule"] < 0.7 * error["uniform"]
    assert error[result.default_plan] <= error["schedule"]
    assert artifact.manifest.default_plan == result.default_plan


@pytest.mark.slow
def test_the_rate_of_training_is_kept_until_another_one_is_said(artifact: Path, tmp_path: Path) -> None:
    silent, said = policies.record(tmp_path / "silent.npz"), policies.record(tmp_path / "said.npz")
    np.savez(said, **np.load(said), meta=np.array('{"policy_hz": 12.5}'))

    def learned(path: Path, **given: Any) -> float | None:
        quick(artifact, path, learn=("interval",), **given)
        return ttscompile.load(artifact).info.policy_hz

    assert learned(silent) is None
    assert learned(said) == learned(silent) == 12.5
    assert learned(silent, policy_hz=20.0) == 20.0


@pytest.mark.slow
def test_what_it_measured_is_what_the_artifact_does(
    calibrated: tuple[Path, CalibrationResult], recording: Path
) -> None:
    """The errors again, through the public interface and onnxruntime; with other noise, so about the same."""
    directory, result = calibrated
    policy = ttscompile.load(directory)
    with np.load(recording) as file:
        rows, ends = file["obs"], [0, *file["episode_ends"]]
    obs = {"obs": np.concatenate([rows[ends[i] : ends[i + 1]] for i in result.episodes["validation"]] * 8)}
    draw = np.random.default_rng(5)
    shape = (len(obs["obs"]), policies.HORIZON, policies.CHANNELS)
    initial, steps = (draw.standard_normal(size, dtype=np.float32) for size in (shape, (policies.STEPS, *shape)))
    noise = ttscompile.Noise(initial, steps)
    actions = {}
    for plan in ("dense", "schedule", "uniform"):
        policy.reset()
        actions[plan] = policy.predict_action(obs, noise=noise, plan=plan)["action"]
    for plan in ("schedule", "uniform"):
        error = np.abs(actions[plan] - actions["dense"]).mean()
        assert error == pytest.approx(result.plans[plan].error, rel=0.35)
    policy.reset()
    other = ttscompile.Noise(initial[::-1].copy(), steps[:, ::-1].copy())
    apart = np.abs(policy.predict_action(obs, noise=other, plan="dense")["action"] - actions["dense"]).mean()
    assert apart == pytest.approx(result.other_noise, rel=0.35)


@pytest.mark.slow
def test_the_record_is_in_the_artifact(calibrated: tuple[Path, CalibrationResult]) -> None:
    directory, result = calibrated
    manifest = load_artifact(directory).manifest
    assert manifest.calibration is not None
    record = json.loads(json.dumps(dict(manifest.calibration)))
    assert record["plans"]["schedule"]["error"] == pytest.approx(result.plans["schedule"].error)
    assert record["plans"][result.default_plan]["sparsity"] == pytest.approx(result.sparsity)
    assert record["other_noise"] == pytest.approx(result.other_noise)
    assert record["other_noise"] > 0
    assert record["stopped"] == result.stopped == "finished"
    assert set(manifest.plans) == set(result.plans)
    assert record["budget"] == {"target_sparsity": TARGET, "cells": 18}
    assert not (directory / FILE).exists()


@pytest.mark.slow
def test_another_seed_gives_another_split(
    calibrated: tuple[Path, CalibrationResult], artifact: Path, recording: Path
) -> None:
    other = quick(artifact, recording, learn=("interval",), seed=3)
    assert other.episodes != calibrated[1].episodes


@pytest.mark.slow
@pytest.mark.parametrize(
    "saves", [pytest.param(1, marks=pytest.mark.soak), 5, pytest.param(7, marks=pytest.mark.soak)]
)  # during targets, search and adaptation
def test_resuming_after_a_kill_ends_where_it_would_have_ended(
    calibrated: tuple[Path, CalibrationResult],
    artifact: Path,
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    saves: int,
) -> None:
    before = load_artifact(artifact).manifest.identity
    with killed(saves):
        quick(artifact, recording, max_intervals=None)
    assert load_artifact(artifact).manifest.identity == before  # the artifact works as it did
    counted = _count_targets(monkeypatch)
    result = quick(artifact, recording, max_intervals=None, resume=True)
    assert contents(artifact) == contents(calibrated[0])
    assert counted() < result.calls["calibration"] + DRAWS * result.calls["validation"]  # some were known


def _count_targets(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    count = 0
    run_dense = Runner.run_dense

    def counting(self: Runner, calls: Any) -> Any:
        nonlocal count
        count += calls.count
        return run_dense(self, calls)

    monkeypatch.setattr(Runner, "run_dense", counting)
    return lambda: count


@pytest.mark.slow
def test_without_resume_it_begins_anew_and_the_same_seed_gives_the_same_bytes(
    calibrated: tuple[Path, CalibrationResult], artifact: Path, recording: Path
) -> None:
    (artifact / FILE).write_bytes(b"left by something else")
    quick(artifact, recording, max_intervals=None)
    assert contents(artifact) == contents(calibrated[0])


@pytest.mark.slow
def test_a_damaged_state_is_refused(artifact: Path, recording: Path) -> None:
    (artifact / FILE).write_bytes(b"no state")
    with pytest.raises(CalibrationError, match="without --resume"):
        quick(artifact, recording, resume=True)


@pytest.mark.parametrize("change", [{"seed": 1}, {"target_sparsity": 0.6}])
def test_a_state_of_other_settings_is_refused(artifact: Path, recording: Path, change: dict[str, Any]) -> None:
    with killed():
        quick(artifact, recording)
    with pytest.raises(CalibrationError, match=r"other settings: \w+ was .*, now"):
        quick(artifact, recording, resume=True, **change)


def test_resuming_with_more_time_goes_on_with_the_same_calls(artifact: Path, recording: Path) -> None:
    with killed(saves=3):  # of what is judged, and of the first calls to learn from
        quick(artifact, recording, learn=("interval",), max_minutes=1e-6)
    result = quick(artifact, recording, learn=("interval",), max_minutes=2, resume=True)
    assert result.calls["calibration"] == 64


def test_the_time_limit_ends_the_search_with_the_best_plan_so_far(artifact: Path, recording: Path) -> None:
    result = quick(artifact, recording, max_intervals=None, max_minutes=1e-6)
    assert result.stopped == "time limit"
    assert result.intervals == 1
    assert result.sparsity >= TARGET


def test_the_schedule_of_interval_is_the_uniform_one(artifact: Path, recording: Path) -> None:
    result = quick(artifact, recording, learn=("interval",))
    loaded = load_artifact(artifact)
    np.testing.assert_array_equal(loaded.plans["schedule"].cells, loaded.plans["uniform"].cells)
    assert result.default_plan == "schedule"
    assert "pruner" not in loaded.manifest.plans


def test_no_better_than_uniform_is_a_failure_that_changes_nothing(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(artifact)

    monkeypatch.setattr(bac, "bac", static.interval)
    with pytest.raises(CalibrationFailedError, match="no better than the uniform schedule"):
        quick(artifact, recording, learn=("bac",))
    assert {n: c for n, c in contents(artifact).items() if n != FILE} == before


@pytest.mark.parametrize("target", [0.95, 0.901])
def test_a_target_out_of_reach_is_refused(artifact: Path, recording: Path, target: float) -> None:
    with pytest.raises(CalibrationError, match=r"at most 0\.9 of the 10 x 6 cells"):
        quick(artifact, recording, target_sparsity=target)


def test_the_highest_target_leaves_step_0(artifact: Path, recording: Path) -> None:
    result = quick(artifact, recording, target_sparsity=0.9, learn=("interval",))
    assert result.sparsity == pytest.approx(0.9)


@pytest.mark.parametrize("arguments", [{"validation_fraction": 0.0}, {"validation_fraction": 1.0}, {"max_minutes": 0}])
def test_bad_settings_are_refused(artifact: Path, recording: Path, arguments: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError, match="between 0 and 1"):
        quick(artifact, recording, **arguments)


def test_what_cannot_be_learned_is_refused_before_any_work(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = _count_targets(monkeypatch)
    with pytest.raises(CalibrationError, match="expected some of schedule, tts-paper, .*, start; found 'magic'"):
        quick(artifact, recording, learn=("magic",))
    with pytest.raises(CalibrationError, match="makes the first plan; found 'schedule' and 'bac'. Take one"):
        quick(artifact, recording, learn=("bac", "weights", "schedule"))
    assert counted() == 0


def test_one_episode_is_refused(artifact: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="one episode; expected at least two"):
        quick(artifact, policies.record(tmp_path / "one.npz", episodes=1))


def test_two_short_episodes_are_enough(artifact: Path, tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    path = tmp_path / "short.npz"
    np.savez(path, obs=draw.standard_normal((2, 2, 3)).astype(np.float32), episode_ends=[1, 2])
    result = quick(artifact, path, learn=("interval",))
    assert result.calls == {"calibration": 8, "validation": 1}  # each observation with eight noises


def test_recordings_that_are_too_short_are_told_of(
    artifact: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    draw = np.random.default_rng(0)
    path = tmp_path / "short.npz"
    np.savez(path, obs=draw.standard_normal((9, 2, 3)).astype(np.float32), episode_ends=[2, 5, 8, 9])
    quick(artifact, path, learn=("interval",), correct=True, progress=True)
    assert "calls to learn from, and a correction needs 147" in capsys.readouterr().err
    quick(artifact, path, learn=("tts-paper",), max_intervals=1, progress=True)
    assert "2 of 4 episodes have fewer than 3 calls, and are left out" in capsys.readouterr().err


@pytest.mark.slow
def test_constant_observations_are_fine(artifact: Path, tmp_path: Path) -> None:
    path = tmp_path / "constant.npz"
    obs = np.repeat(np.arange(4, dtype=np.float32) / 8, 6)[:, None, None] * np.ones((2, 3), np.float32)
    np.savez(path, obs=obs, episode_ends=[6, 12, 18, 24])
    result = quick(artifact, path, max_intervals=None)
    assert result.default_plan == "schedule"


def test_not_an_artifact_is_refused(tmp_path: Path, recording: Path) -> None:
    with pytest.raises(ArtifactError):
        quick(tmp_path, recording)


@pytest.mark.parametrize("count", [2, 3, 8, 100])
@pytest.mark.parametrize("fraction", [0.01, 0.25, 0.99])
def test_the_split_is_by_episode(count: int, fraction: float) -> None:
    split = split_episodes(count, fraction, seed=0)
    assert sorted(split.calibration + split.validation) == list(range(count))
    assert split.calibration
    assert split.validation
    assert split == split_episodes(count, fraction, seed=0)
    if count == 100:
        assert split != split_episodes(count, fraction, seed=1)
        assert len(split.validation) == round(100 * fraction)


def test_who_fits_corrections_is_not_asked_to(compiled: Path, recording: Path, tmp_path: Path) -> None:
    directory = Path(shutil.copytree(compiled, tmp_path / "compiled"))
    before = contents(directory)
    with pytest.raises(CalibrationError, match="'schedule' fits a correction of its own. Leave correct out"):
        quick(directory, recording, correct=True)
    assert contents(directory) == before


@pytest.mark.slow
def test_a_rival_is_corrected_on_request(compiled: Path, recording: Path, tmp_path: Path) -> None:
    """The schedule stays what it is; its errors fall, and the artifact keeps the correction."""
    results, schedules = [], []
    for correct in (False, True):
        directory = Path(shutil.copytree(compiled, tmp_path / f"{correct}"))
        results.append(quick(directory, recording, learn=("interval",), correct=correct, max_intervals=None))
        artifact = load_artifact(directory)
        schedules.append(artifact.plans["schedule"].cells)
        assert ((artifact.manifest.calibration or {}).get("corrected") is True) == correct
        assert (artifact.plans["schedule"].correction is not None) == correct
    np.testing.assert_array_equal(schedules[0], schedules[1])
    plain, corrected = (policies.errors(result)["schedule"] for result in results)
    assert corrected < 0.7 * plain
