"""What the pages say of where things are: the walks through the code, and where old commands went."""

from __future__ import annotations

import ast
import re

import pytest

from tests.pages import EXTENDING, ROOT
from ttscompile.cli import main

WALKS = (EXTENDING / "walks.md").read_text()
STEPS = [
    " ".join(step.split()) for step in re.findall(r"^\d+\. (.*?)(?=^\d+\. |^#|\Z)", WALKS, re.DOTALL | re.MULTILINE)
]
TABLE = (ROOT / "docs" / "reference" / "commands.md").read_text().partition("## Where things went")[2]


def defined(file: str) -> set[str]:
    made = ast.walk(ast.parse((ROOT / file).read_text()))
    return {node.name for node in made if isinstance(node, ast.FunctionDef | ast.ClassDef)}


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step[:50])
def test_the_files_of_a_step_have_what_it_names(step: str) -> None:
    quoted = re.findall(r"`([^`]+)`", step)
    files = [each for each in quoted if each.endswith(".py")]
    names = [each for each in quoted if each.isidentifier()]
    assert files
    assert names
    assert set(names) <= set().union(*map(defined, files))


def test_there_are_three_walks_of_ten_steps() -> None:
    assert len(re.findall(r"^## ", WALKS, re.MULTILINE)) == 3
    assert len(STEPS) == 30


def test_what_took_the_place_of_a_command_is_there_and_the_command_is_not() -> None:
    rows = [line.strip("| ").split(" | ") for line in TABLE.splitlines() if line.startswith("| `")]
    assert len(rows) >= 10
    for before, now in rows:
        for old in re.findall(r"`([^`]+)`", before):
            command, *options = old.split()
            known = {name for each in main.commands[command].params for name in each.opts} if options else main.commands
            assert (options or [command])[0] not in known or "tts-switches" in old, old
        for new in re.findall(r"`((?:bench|inspect|serve|calibrate) [^`]+)`", now):
            command, *words = new.split()
            known = {name for each in main.commands[command].params for name in each.opts}
            assert {word for word in words if word.startswith("-")} <= known, new
        for file in re.findall(r"examples/[\w/]+\.py", now):
            assert (ROOT / file).is_file(), file
