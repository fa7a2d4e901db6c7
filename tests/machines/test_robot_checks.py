"""What the commands of this folder check, on this machine: the same answers pass, and others do not."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.plans import store_schedules
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.measure.machine import cpuinfo

from . import arm, made, matrix, robot

PLANS = ("dense", "uniform")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``made.py`` leaves for one policy, without blocks of eight bits: the toy has none."""
    folder = tmp_path_factory.mktemp("made") / "toy"
    artifact = written_artifact(toy_program(noise=0.0, pruner=False), folder / "artifact").path
    store_schedules(artifact, None, {"uniform": uniform_plan(5, 5, 3)}, "uniform", {"learned": ["by hand"]})
    answers: dict[str, Any] = dict(made.answers(artifact, ("fp32",)))
    np.savez(folder / "actions.npz", **answers)
    return folder


def found(folder: Path) -> list[robot.Check]:
    return list(robot.compare("toy", folder / "artifact", folder / "actions.npz"))


@pytest.mark.slow
def test_the_machine_that_compiled_agrees_with_itself(folder: Path) -> None:
    checks = found(folder)
    assert [check.what for check in checks] == [f"actions toy fp32 {plan}" for plan in PLANS]
    assert all(check.passed for check in checks)


def test_what_a_loop_draws_in_its_steps_goes_along(tmp_path: Path) -> None:
    artifact = written_artifact(toy_program(pruner=False), tmp_path / "artifact").path
    answers: dict[str, Any] = dict(made.answers(artifact, ("fp32",)))
    assert answers["1/steps/dense"].shape == (5, *answers["1/noise"].shape)
    np.savez(tmp_path / "actions.npz", **answers)
    assert [check.passed for check in found(tmp_path)] == [True]
    np.savez(tmp_path / "actions.npz", **{**answers, "1/steps/dense": answers["0/steps/dense"]})
    assert [check.passed for check in found(tmp_path)] == [False]


def test_the_tests_of_a_robot_are_collected_without_the_compiler(tmp_path: Path) -> None:
    """What their modules import is there; an absent package is as one whose entry in sys.modules is None."""
    code = f"import sys; sys.modules.update(dict.fromkeys({robot.COMPILERS})); import pytest; sys.exit(pytest.main())"
    words = [sys.executable, "-c", code, *robot.selected(tmp_path), "--collect-only"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=robot.ROOT, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(("off", "passed"), [(0.5e-5, True), (2e-5, False)])
def test_actions_may_differ_by_a_hundred_thousandth_of_their_range(
    folder: Path, tmp_path: Path, off: float, passed: bool
) -> None:
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    with np.load(other / "actions.npz") as stored:
        arrays = dict(stored)
    reach = np.ptp(np.stack([arrays[f"{call}/action/fp32/dense"] for call in range(made.CALLS)]))
    arrays["2/action/fp32/dense"][0, 0, 0] += off * reach
    np.savez(other / "actions.npz", **arrays)
    assert [check.passed for check in found(other)] == [passed, True]


def test_eight_bits_are_judged_by_their_distance_from_fp32() -> None:
    """0.01 of the range on x86, so 0.02 here; wherever they are from each other."""
    exact = np.array([0.0, 1.0])
    assert robot.judged("actions", exact - [0.015, 0], exact, robot.GROWTH * 0.01, 0.025).passed
    assert not robot.judged("actions", exact - [0.025, 0], exact, robot.GROWTH * 0.01, 0.015).passed


def test_beside_the_compiler_nothing_is_proven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert robot.main(tmp_path, ()) == 2
    assert "found torch" in capsys.readouterr().out


def test_an_emulated_processor_is_what_its_root_says(tmp_path: Path) -> None:
    root = tmp_path / "a folder" / "root"
    (root / "usr" / "bin").mkdir(parents=True)
    script = arm.emulated_python(root, "cortex-a72")
    assert cpuinfo(root / "proc" / "cpuinfo")["CPU part"] == "0xd08"
    assert "asimddp" not in cpuinfo(root / "proc" / "cpuinfo")["Features"]
    emulator = tmp_path / arm.QEMU
    emulator.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')  # tells what it was given
    emulator.chmod(0o755)
    told = subprocess.run([script, "-c", "one two"], env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    words = ["-cpu", "cortex-a72", "-L", str(root), "-E", f"EMULATED_PYTHON={script}", f"{root}/usr/bin/python3.11"]
    assert told.stdout.splitlines() == [*words, "-c", "one two"]


def test_the_matrix_has_a_row_for_what_is_not_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pyenv, PATH, and the emulator there is this Python, in an environment, and one core of it."""
    monkeypatch.setattr(matrix, "environment", lambda version, interpreter: tmp_path / version / "bin" / "python")
    monkeypatch.setattr(matrix, "PLACE", tmp_path)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(matrix, "PYTHONS", (f"{sys.version_info.major}.{sys.version_info.minor}", "3.99"))
    here, absent, core, emulated = matrix.rows(tmp_path)
    assert not here.absent and not core.absent
    assert core.words[: len(matrix.ONE_CORE)] == matrix.ONE_CORE
    assert "no python3.99" in absent.absent
    assert "qemu-user-static" in emulated.absent
    pyenv = tmp_path / ".pyenv" / "versions"
    for name in ("3.99.2", "3.99.10"):
        (pyenv / name / "bin").mkdir(parents=True)
        (pyenv / name / "bin" / "python").touch()
    assert matrix.find_python("3.99") == pyenv / "3.99.10" / "bin" / "python"


@pytest.mark.parametrize(("program", "told"), [("true", "passed"), ("false", "FAILED")])
def test_a_row_is_judged_by_its_exit_status(program: str, told: str) -> None:
    assert matrix.outcome([program]) == told
