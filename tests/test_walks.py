"""What the pages say of where things are in the code: the walks."""

from __future__ import annotations

import ast
import re

import pytest

from tests.pages import EXTENDING, ROOT

WALKS = (EXTENDING / "walks.md").read_text()
STEPS = [
    " ".join(step.split()) for step in re.findall(r"^\d+\. (.*?)(?=^\d+\. |^#|\Z)", WALKS, re.DOTALL | re.MULTILINE)
]


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
