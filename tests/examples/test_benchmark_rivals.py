"""The script that compares rivals: what it prints, and what it refuses; and the one of calls in a row."""

import json
import shutil
from pathlib import Path
from typing import Any

import in_a_row
import pytest
from click.testing import CliRunner
from rivals import default_sparsities, main

from ttscompile.artifact.load import load_artifact


@pytest.fixture(scope="module")
def arguments(compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a copy, since a search keeps its state in the artifact's folder."""
    copy = shutil.copytree(compiled, tmp_path_factory.mktemp("searched") / "compiled")
    return [str(copy), "-t", str(recording), "--calls", "2"]


def run(*words: str) -> Any:
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.stderr
    return result


@pytest.mark.slow
def test_it_prints_the_same_as_a_table_and_as_json(arguments: list[str], tmp_path: Path) -> None:
    asked = [*arguments, "--learn", "interval", "--sparsities", "0.5,0.8"]
    told = run(*asked, "--correct", "--json", "--plot", str(tmp_path / "f.svg"), "--into", str(tmp_path / "found"))
    record = json.loads(told.stdout)
    points = record["comparison"]["points"]
    assert [point["series"] for point in points] == ["this artifact"] + ["interval", "interval, corrected"] * 2
    found = load_artifact(tmp_path / "found").plans
    assert {name for name in found if name.startswith("interval")} == {
        *("interval-0.5", "interval-corrected-0.5", "interval-0.8", "interval-corrected-0.8")
    }
    assert found["interval-0.5"].correction is None
    assert found["interval-corrected-0.5"].correction is not None
    assert record["identity"] == load_artifact(Path(arguments[0])).manifest.identity
    assert "held-out calls" in (tmp_path / "f.svg").read_text()
    assert told.stderr.count("search: interval 0.8: ") == 1  # a log has a line for each part of the work, and no bar
    shown = run(*asked, "--correct").stdout
    assert "in which two calls of the original are" in " ".join(shown.split())
    assert all(f"{point['sparsity']:.1%}" in shown for point in points)


def test_without_sparsities_those_are_taken_that_the_steps_allow(arguments: list[str]) -> None:
    assert default_sparsities(100) == (0.9, 0.95, 0.98)
    assert default_sparsities(16) == (11 / 16, 13 / 16, 14 / 16)
    assert (default_sparsities(3), default_sparsities(2), default_sparsities(1)) == ((1 - 2 / 3,), (0.5,), ())
    told = run(*arguments, "--json", "--learn", "interval")  # of ten steps: 95 % is none
    found = json.loads(told.stdout)["comparison"]["points"]
    assert [point["name"] for point in found if point["series"] == "interval"] == ["0.5", "0.7", "0.8"]
    alone = run(*arguments, "--json", "--learn", "")
    assert {point["series"] for point in json.loads(alone.stdout)["comparison"]["points"]} == {"this artifact"}


def test_plans_are_not_written_over_what_takes_part(arguments: list[str]) -> None:
    result = CliRunner().invoke(main, [*arguments, "--into", arguments[0]])
    assert result.exit_code == 2
    assert "takes part" in result.stderr
    assert load_artifact(Path(arguments[0])).path.is_dir()


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--learn", "magic", "'magic' is not one of schedule, tts-paper"),
        ("--sparsities", "0.9,x", "could not convert"),
        ("--sparsities", "1", "1 is not above 0 and below 1"),
    ],
)
def test_bad_lists_are_refused(arguments: list[str], option: str, value: str, message: str) -> None:
    result = CliRunner().invoke(main, [*arguments, option, value])
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.mark.slow
def test_calls_in_a_row_are_timed_and_told(tiny_artifact: Path) -> None:
    result = CliRunner().invoke(in_a_row.main, [str(tiny_artifact), "--calls", "1", "--in-a-row", "2"])
    assert result.exit_code == 0, result.stderr
    assert "The last of 2 calls in a row: its caches are warm." in result.stdout
    assert "dense" in result.stdout and "speed-up" in result.stdout
