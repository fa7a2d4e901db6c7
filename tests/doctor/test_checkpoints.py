"""The doctor on a checkpoint and on recordings, and what ``convert`` says of the same."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.commands import refused, run
from tests.policies.lerobot_tiny import DS, save_policy
from ttscompile import driver
from ttscompile.artifact.load import load_artifact
from ttscompile.core.finding import Level
from ttscompile.doctor.target import target_findings


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """Its last number of the state never changed."""
    return save_policy(tmp_path)


def recorded(path: Path, state: np.ndarray) -> Path:
    count = len(state)
    tokens = np.zeros((count, 9), np.int64)
    arrays: dict[str, Any] = {"observation.state": state, "observation.language.tokens": tokens}
    arrays |= {"observation.language.attention_mask": tokens == 0, "meta": '{"frames": true}'}
    np.savez(path, episode_ends=[count // 2, count], **arrays)
    return path


def test_a_checkpoint_and_its_recordings_as_json_and_as_text(checkpoint: Path, tmp_path: Path) -> None:
    bad = recorded(tmp_path / "bad.npz", np.linspace(1e4, 2e4, 20 * DS, dtype=np.float32).reshape(20, DS))
    words = ("doctor", checkpoint, "-t", bad)
    result = run(*words, "--json")
    told = json.loads(result.stdout)
    by_name = {one["what"]: one for one in told["findings"]}
    assert (result.exit_code, told["problems"]) == (1, 1)
    assert by_name["range of 'observation.state'"]["level"] == "problem"
    assert by_name["normaliser of observation.state"]["level"] == "warning"
    text = run(*words).stdout
    assert "PROBLEM range of 'observation.state'" in text and "  -> Look at" in text and "1 problem, " in text


def test_recordings_are_held_against_an_artifact_too(toy_compiled: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", pose=np.zeros((4, 2), np.float32), episode_ends=np.array([2, 4]))
    found = {one.what: one for one in target_findings(toy_compiled, [tmp_path / "other.npz"])}
    assert "call" in found and "lacks " in found["other.npz"].found


def test_one_episode_is_too_few_to_calibrate_with(toy_compiled: Path, tmp_path: Path) -> None:
    shape = load_artifact(toy_compiled).manifest.spec.observations["obs"].shape
    for episodes in (1, 2):
        ends = 3 * np.arange(1, episodes + 1)
        obs = np.arange(ends[-1] * np.prod(shape)).reshape(-1, *shape)
        np.savez(tmp_path / "calls.npz", obs=obs, episode_ends=ends)
        found = {one.what: one for one in target_findings(toy_compiled, [tmp_path / "calls.npz"])}
        assert found["calls"].found == f"{3 * episodes} in {episodes} episodes"
        assert (found["calls"].level is Level.PROBLEM) == (episodes == 1)


def test_what_is_no_policy_is_a_problem_with_the_message_of_convert(tmp_path: Path) -> None:
    (tmp_path / "policy.ckpt").write_text("nothing")
    (one,) = target_findings(tmp_path / "policy.ckpt")
    assert one.what == "load" and "policy.ckpt" in one.found and one.remedy


def test_recordings_without_a_target_are_bad_usage(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.npz", np.zeros((4, DS), np.float32))
    assert "give a checkpoint or an artifact too" in refused("doctor", "-t", path)


def test_convert_says_the_same_and_goes_on(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(driver, "_compile", lambda *given: compiled.append(given))
    with pytest.warns(UserWarning, match=r"^normaliser of observation\.state: its range is 0 in column 4 of 5"):
        ttscompile.convert(checkpoint, tmp_path / "out")
    assert compiled


def test_what_makes_answers_meaningless_is_a_warning_of_convert(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "_compile", lambda *_: None)
    steps = json.loads((checkpoint / "policy_preprocessor.json").read_text())
    del steps["steps"][-1]["state_file"]
    (checkpoint / "policy_preprocessor.json").write_text(json.dumps(steps))
    with pytest.warns(UserWarning, match=r"no statistics of observation\.state"):
        ttscompile.convert(checkpoint, tmp_path / "out")
