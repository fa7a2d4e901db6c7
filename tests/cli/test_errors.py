"""Bad usage and bad input: one message, exit status 2, no traceback, nothing left behind."""

import errno
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.commands import done, refused, run
from ttscompile.cli.output import print_json


@pytest.fixture
def no_checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "notes.ckpt"
    path.write_text("not a checkpoint")
    return path


def test_a_file_that_is_no_checkpoint(no_checkpoint: Path) -> None:
    out = no_checkpoint.with_name("compiled")
    assert re.match(f"error: .*{no_checkpoint}", refused("convert", no_checkpoint, "-o", out))
    assert list(no_checkpoint.parent.iterdir()) == [no_checkpoint]


@pytest.mark.parametrize("command", ["inspect", "bench", "calibrate"])
@pytest.mark.parametrize("made", [False, True])
def test_what_is_no_artifact(command: str, made: bool, tmp_path: Path) -> None:
    directory = tmp_path / "nothing"
    if made:
        directory.mkdir()
    result = run(command, directory, *["--trajectories", "calls.npz"] * (command == "calibrate"))
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert str(directory) in result.stderr


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["convert", "policy.ckpt"], "Missing option '-o'"),
        (["convert", "policy.ckpt", "-o", "out", "--sampler", "pndm"], "'pndm' is not one of"),
        (["convert", "policy.ckpt", "-o", "out", "--steps", "0"], "not in the range"),
        (["calibrate", "out"], "Missing option '-t' / '--trajectories'"),
        (["calibrate", "out", "--trajectories"], "Missing option '-t' / '--trajectories'"),
        (["inspect", "out", "--plan", "dense"], "--plan is for --output: give it too"),
        (["inspect", "out", "-o", "page.html", "--plan", "dense"], "--plan is for a picture (.png)"),
        (["inspect", "out", "-o", "plan.png", "--verify"], "--verify is for a page (.html)"),
        (["bench", "out", "--encoders", "."], "--encoders is for --checkpoint: give it too"),
        (["bench", "out", "--plot", "f.png"], "--plot is for --trajectories: give it too"),
        (["bench", "out", "--runtime", ""], "--runtime: nothing was given"),
        (["predict", "out", "--seed", "-1"], "-1 is not in the range 0<=x<="),
        (["serve", "out"], "give --control-hz HZ to drive one robot, or --copies N or --openpi to answer many"),
        (["serve", "out", "--control-hz", "10", "--ray", "local"], "--ray is for --copies: give it too"),
        (["inspect", "out", "-o", "page.txt"], "expected a page (.html) or a picture (.png, .svg, .pdf)"),
        (["inspect", "out", "--verify"], "--verify is for --output: give it too"),
        (["inspect", "out", "-t", "calls.npz"], "--trajectories is for --output: give it too"),
        (["deploy"], "No such command"),
    ],
)
def test_bad_usage(arguments: list[str], reason: str) -> None:
    assert reason in refused(*arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ["convert", "-o", "out", "no.ckpt"],
        ["convert", "here.ckpt", "-o", "."],
        ["calibrate", "--trajectories", "here.ckpt", "--max-minutes", "1", "nowhere"],
        ["calibrate", "compiled", "--trajectories", "no.npz"],
        ["bench", "compiled", "-t", "no.npz"],
    ],
)
def test_what_is_not_there_is_said_before_the_compiler_is_imported(
    arguments: list[str], toy_compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "compiled").symlink_to(toy_compiled)
    (tmp_path / "here.ckpt").touch()
    monkeypatch.chdir(tmp_path)
    for module in ("driver", "calibration.pipeline", "calibration.compare"):
        monkeypatch.setitem(sys.modules, f"ttscompile.{module}", None)
    for name in ("convert", "calibrate"):
        monkeypatch.delitem(vars(ttscompile), name, raising=False)
    wrong = str(tmp_path) if arguments[-1] == "." else arguments[-1]
    assert refused(*arguments).startswith(f"error: {wrong}: ")


def test_pictures_that_cannot_be_drawn(toy_compiled: Path, tmp_path: Path) -> None:
    for name in ("no folder/x.png", "x.foo", "x", ".png"):
        why = "the picture cannot be written" if "/" in name else "expected a page (.html) or a picture (.png"
        assert why in refused("inspect", toy_compiled, "-o", tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_picture_takes_the_place_of_files_alone(toy_compiled: Path, tmp_path: Path) -> None:
    """And has it only when it is whole."""
    folder, null, picture = tmp_path / "folder.png", tmp_path / "null.png", tmp_path / ("p" * 251 + ".png")
    folder.mkdir()
    null.symlink_to("/dev/null")
    for path in (folder, null):
        assert refused("inspect", toy_compiled, "-o", path)
    assert null.is_symlink()
    picture.write_text("the old one")
    done("inspect", toy_compiled, "-o", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(tmp_path.iterdir()) == sorted([folder, null, picture])


def test_what_the_system_refuses_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "out/x")

    monkeypatch.setattr(sys.modules["ttscompile.cli.inspect"], "load_artifact", full)
    told = "error: [Errno 28] No space left on device: 'out/x'. Make space where the results go, and run this again."
    assert refused("inspect", "out") == told


def test_a_folder_of_something_else_is_refused_before_the_checkpoint_is_read(no_checkpoint: Path) -> None:
    told = refused("convert", no_checkpoint, "-o", no_checkpoint.parent)
    assert "expected an empty directory or a ttscompile artifact; found one that holds notes.ckpt" in told


def test_figures_that_are_no_numbers_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": float("nan"), "b": [1.5, (float("inf"), np.float64("nan"))], "c": {"d": "nan"}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [1.5, [None, None]], "c": {"d": "nan"}}


def test_names_are_shown_as_they_are(toy_compiled: Path, tmp_path: Path) -> None:
    directory = Path(shutil.copytree(toy_compiled, tmp_path / "[red]x :car:"))
    assert "[red]x :car:" in "".join(done("inspect", directory).stdout.split("\n")).replace("  ", "")
