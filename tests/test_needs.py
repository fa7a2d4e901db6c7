"""The table of what users ask for: every test that it names is there, and every command."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from ttscompile.cli import main

ROOT = Path(__file__).resolve().parents[1]
TABLE = [line for line in (ROOT / "docs" / "needs.md").read_text().splitlines() if line.startswith("| ")]
ROWS = [line.split(" | ") for line in TABLE[2:]]


def there(name: str) -> bool:
    """Whether ``tests/file.py::test_name`` is a test."""
    file, _, function = name.partition("::")
    path = ROOT / file
    if not path.is_file():
        return False
    made = ast.walk(ast.parse(path.read_text()))
    return any(isinstance(node, ast.FunctionDef) and node.name == function for node in made)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][2:30])
def test_a_need_has_a_page_and_a_test_that_is_there(row: list[str]) -> None:
    need, answer, where, test = row
    assert need and answer
    (link,) = re.findall(r"\]\(([^)#]+)", where)
    assert (ROOT / "docs" / link).is_file()
    assert set(re.findall(r"\[`(\w+)`\]", where)) <= set(main.commands)
    (name,) = re.findall(r"`(tests/\S+::test_\w+)`", test)
    assert there(name), name


def test_a_test_that_is_not_there_is_found() -> None:
    assert len(ROWS) > 20
    assert there("tests/test_needs.py::test_a_test_that_is_not_there_is_found")
    assert not there("tests/test_needs.py::test_of_nothing") and not there("tests/test_nothing.py::test_of_nothing")
