"""The table of what users ask for: every test that it names is there, and every command."""

from __future__ import annotations

import re

import pytest

from tests.pages import ROOT, there
from ttscompile.cli import main

TABLE = [line for line in (ROOT / "docs" / "needs.md").read_text().splitlines() if line.startswith("| ")]
ROWS = [line.split(" | ") for line in TABLE[2:]]


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
