"""The script that holds criteria against the plans that they are frozen into: who answers, and what it prints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import online
import pytest
from click.testing import CliRunner


@pytest.fixture(scope="module")
def arguments(compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a copy, since a search keeps its state in the artifact's folder."""
    copy = shutil.copytree(compiled, tmp_path_factory.mktemp("searched") / "compiled")
    limits = ["--calls", "6", "--learned-calls", "12", "--rounds", "2"]
    return [str(copy), "-t", str(recording), "--sparsities", "0.5,0.8", *limits]


@pytest.mark.slow
def test_a_criterion_answers_twice_and_others_once(arguments: list[str]) -> None:
    asked = [*arguments, "--learn", "teacache,taylorseer,dbcache"]
    made = CliRunner().invoke(online.main, [*asked, "--json"])
    assert made.exit_code == 0, made.output
    told = json.loads(made.stdout)
    rows = {(row["name"], row["decides"]): row for row in told["rows"]}
    assert {name for name, decides in rows if decides == "online"} == {"teacache 0.5", "teacache 0.8", "dbcache 0.5"}
    assert {name for name, decides in rows if decides == "frozen"} == {"teacache 0.5", "teacache 0.8", "dbcache 0.5"}
    assert told["left_out"] == [one for one in told["left_out"] if one.startswith("dbcache 0.8: 'dbcache'")]
    assert rows["every step", ""]["error"] == 0 and rows["every step", ""]["cells"] == [60.0, 60]
    assert rows["taylorseer 0.5", ""]["cells"] == [30.0, 30]
    assert rows["teacache 0.5", "online"]["cells"][0] <= rows["teacache 0.5", "online"]["cells"][1]
    asked_once_more = {name for name, decides in rows if decides == "online, corrected"}
    assert set(told["tables"]) == {"teacache 0.5", "teacache 0.8", "dbcache 0.5"}
    assert asked_once_more == {name for name, (plain, *others) in told["tables"].items() if min(others) < plain}
    times = [row["ms"] for row in told["rows"]]
    assert times == sorted(times)
    shown = CliRunner().invoke(online.main, [*arguments, "--learn", "interval"])
    assert "interval 0.8" in shown.stdout
    assert "6 calls of episodes that nothing was learned from" in " ".join(shown.stdout.split())
