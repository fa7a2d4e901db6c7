"""``ttscompile verify``; and that every command says which artifact its figures are of."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from ttscompile import AsyncExecutor, ExecutorSettings, GuardLimits, load
from ttscompile.artifact.load import read_manifest
from ttscompile.cli import main

from . import policy
from .broken import edited


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)


@pytest.mark.slow
def test_a_sound_artifact_gives_status_0(quick: Path, recording: Path) -> None:
    result = run("verify", quick, "--trajectories", recording, "--json")
    assert result.exit_code == 0, result.stdout
    found = json.loads(result.stdout)
    assert found["passed"] is True
    assert found["first_failure"] is None
    assert found["identity"] == read_manifest(quick).identity
    assert {rung["status"] for rung in found["rungs"]} == {"passed"}
    assert found["machine"]["cores"] >= 1


@pytest.mark.slow
def test_a_broken_one_gives_status_1_and_says_where_and_what_to_do(artifact: Path) -> None:
    with edited(artifact, "plans") as arrays:
        arrays["schedule"] = policy.shifted(arrays["schedule"])
    with edited(artifact, "weights") as arrays:
        arrays["narrow.1.weight"] *= 1.1
    result = run("verify", artifact)
    assert result.exit_code == 1
    assert "FAILED at block (step 0, block 3)" in result.stdout
    assert "Convert the checkpoint again" in result.stdout
    assert "What fails above it may only follow from it: evaluation, dense call" in result.stdout
    assert "warning: distance was skipped: " in result.stderr


def test_a_damaged_one_gives_status_1(artifact: Path) -> None:
    (artifact / "stem.onnx").unlink()
    result = run("verify", artifact, "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["first_failure"] == "integrity"
    assert "FAILED at integrity" in run("verify", artifact).stdout


@pytest.mark.parametrize(("name", "reason"), [("nowhere", "does not exist"), (".", "not an artifact")])
def test_bad_input_gives_status_2(name: str, reason: str, tmp_path: Path) -> None:
    result = run("verify", tmp_path / name)
    assert result.exit_code == 2
    assert reason in result.stderr


def test_trajectories_that_do_not_fit_give_status_2(sound: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "calls.npz", state=np.zeros((3, 2, 3), np.float32), episode_ends=[3])
    result = run("verify", sound, "--trajectories", tmp_path / "calls.npz")
    assert result.exit_code == 2
    assert "has no array 'obs'" in result.stderr


COMMANDS: list[tuple[Any, ...]] = [
    ("inspect",),
    ("bench", "--calls", 1),
    ("bench", "--control-hz", 5, "--calls", 1, "--plan", "schedule"),
    ("bench", "--calls", 2, "--trajectories", "RECORDING"),
    ("doctor",),
]


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: str(command[0]))
def test_every_command_says_which_artifact_its_figures_are_of(
    command: tuple[Any, ...], sound: Path, recording: Path
) -> None:
    name, *options = command
    arguments = [recording if one == "RECORDING" else one for one in options]
    identity = read_manifest(sound).identity
    assert identity[:12] in run(name, sound, *arguments).stdout
    assert identity in run(name, sound, *arguments, "--json").stdout


def test_statistics_and_traces_of_the_executor_carry_the_identity(sound: Path) -> None:
    identity = read_manifest(sound).identity
    settings = ExecutorSettings(refuse_infeasible=False, guard=GuardLimits(low=-np.inf, high=np.inf))
    with AsyncExecutor(load(sound), 10, settings, latencies={"schedule": 0.01}) as executor:
        assert executor.statistics().to_json()["identity"] == identity
        assert executor.trace.to_json()["otherData"] == {"identity": identity}
