"""Commands tell of frame pieces where there are some."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.cli import main
from ttscompile.core.plan import TokenReuse


@pytest.fixture(scope="module")
def seeing(once: Once) -> Path:
    return once.folder("seeing", cameras.compile_seeing) / "artifact"


def run(*arguments: object) -> str:
    result = CliRunner().invoke(main, list(map(str, arguments)), env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.stderr
    return result.stdout


def test_inspect_tells_what_is_computed_once_a_frame(seeing: Path, toy_compiled: Path) -> None:
    made = json.loads(run("inspect", seeing, "--json"))
    assert sorted(piece["rows"] for piece in made["frames"]) == [1, 4]
    frames = sum(piece["rows"] * piece["flops"] for piece in made["frames"])
    assert 0.9 * made["flops"]["prologue"] < frames < made["flops"]["prologue"]
    assert "of 5 frames" in run("inspect", seeing)
    assert json.loads(run("inspect", toy_compiled, "--json"))["frames"] == []
    assert "once a frame" not in run("inspect", toy_compiled)


def test_bench_says_how_much_of_a_call_is_frames(seeing: Path, toy_compiled: Path) -> None:
    (measured,) = json.loads(run("bench", seeing, "--calls", 3, "--json"))["contestants"]
    assert 0 < measured["parts_ms"]["frames"] < measured["parts_ms"]["prologue"]
    told = "Every call has frames of its own"
    assert told in run("bench", seeing, "--calls", 1)
    assert told not in run("bench", toy_compiled, "--calls", 1)


@pytest.mark.slow
def test_bench_says_that_plans_which_reuse_tokens_compute_all_of_them(once: Once, tmp_path: Path) -> None:
    folder = shutil.copytree(cameras.compiled_tokens(once) / "artifact", tmp_path / "own")
    artifact = load_artifact(folder)
    update_plans(folder, {**artifact.plans, "some": replace(artifact.default, tokens=TokenReuse(0.1, 6))}, "full")
    told = " ".join(run("bench", folder, "--plan", "some", "--calls", 1).split())
    assert "all tokens of which are computed; frames that are known" in told
    assert "tokens that a plan reuses would cost nothing" in told


def test_the_page_has_a_row_and_a_column_for_them(seeing: Path, tmp_path: Path) -> None:
    run("inspect", seeing, "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "once a frame, or instruction" in page
    assert "of it frames" in page
