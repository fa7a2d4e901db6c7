"""The table of the literature: what its rows name is there, and what is there has a row."""

from __future__ import annotations

import re

import pytest

from tests.pages import ROOT, there
from ttscompile.calibration.proposers import PROPOSERS, SCHEDULES
from ttscompile.frontends.families import FAMILIES
from ttscompile.policies.lerobot.family import TYPES

LINES = (ROOT / "docs" / "references.md").read_text().splitlines()
ROWS = [
    [cell.strip() for cell in line.strip().strip("|").split(" | ")]
    for line in LINES
    if line.startswith("| ") and not line.startswith(("| Work", "| ---"))
]


def named(text: str, pattern: str) -> set[str]:
    """What a pattern's group finds between backticks."""
    return set(re.findall(rf"`[^`]*?{pattern}[^`]*`", text))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:30])
def test_a_row_has_a_test_or_says_that_nothing_is_built(row: list[str]) -> None:
    tests = named(" | ".join(row), r"(tests/\S+::test_\w+)")
    assert len(tests) == (not any(cell.startswith("nothing: ") for cell in row)), row
    assert all(map(there, tests)), tests
    assert named(" | ".join(row), r"--learn ([\w-]+)") <= {one.name for one in PROPOSERS}
    scripts = re.findall(r"`(examples/[^`\s]+\.py)", " | ".join(row))
    assert all((ROOT / script).is_file() for script in scripts), scripts


def test_every_proposer_of_schedules_and_what_it_is_from_has_a_row() -> None:
    found = {name: row for row in ROWS for name in named(" | ".join(row), r"--learn ([\w-]+)")}
    for one in SCHEDULES:
        assert one.name in found
        numbers = set(re.findall(r"\d{4}\.\d{5}", one.what))
        rows = " ".join(" | ".join(row) for row in ROWS if f"--learn {one.name}`" in " | ".join(row))
        assert all(number in rows for number in numbers), f"{one.name}: {numbers}"


def test_every_family_that_is_read_has_a_row() -> None:
    works = [row[0] for row in ROWS]
    assert [one.title for one in FAMILIES if not any(one.title in work for work in works)] == []
    assert [kind for kind in TYPES if not any(f"`{kind}`" in work for work in works)] == []


def test_the_works_that_the_paper_is_known_to_cite_are_counted() -> None:
    """Each has one row, which has a test or says why nothing is built; the page says how many there are."""
    summary, told = ([row[0] for row in ROWS if row[0].endswith(mark)] for mark in "¹²")
    assert (len(set(summary)), len(set(told))) == (len(summary), len(told)) == (18, 16)
    assert not any(mark in " ".join(row[1:]) for row in ROWS for mark in "¹²")
    prose = " ".join(line for line in LINES if not line.startswith("|"))
    assert "cites 32 works" in prose
    assert f"the {len(summary)} works that a published summary" in prose
    assert f"marks {len(told)} more" in prose
    assert f"That is {len(summary) + len(told)}, so at least two" in prose


def test_what_is_missing_is_found() -> None:
    assert len(ROWS) > 65
    assert named("`--learn bac`, `examples/a/b.py`", r"--learn ([\w-]+)") == {"bac"}
    assert not there("tests/test_references.py::test_of_nothing")
    with pytest.raises(AssertionError):
        test_a_row_has_a_test_or_says_that_nothing_is_built(["A work", "a rival", "`--learn bac`", ""])
    with pytest.raises(AssertionError):
        test_a_row_has_a_test_or_says_that_nothing_is_built(["A work", "nothing: so", "`--learn magic`", ""])
