"""What the habits of the house stand on: the marks of tests, and what is measured of them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from . import conftest, untraced
from .covered import ROOT, by_room, room, table

TESTS = ROOT / "tests"


def counted(path: Path) -> tuple[int, int]:
    """How many test functions a file has, and how many of them are slow or alone, by themselves or with all of it."""
    tree = ast.parse(path.read_text())
    marks = ("pytest.mark.slow", "pytest.mark.alone")
    every = any(isinstance(node, ast.Assign) and any(mark in ast.unparse(node) for mark in marks) for node in tree.body)
    found = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    kept = [node for node in found if any(mark in ast.unparse(each) for each in node.decorator_list for mark in marks)]
    return len(found), len(found) if every else len(kept)


def test_the_marks_of_a_file_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "test_x.py"
    path.write_text("@pytest.mark.slow\ndef test_a(): ...\n\ndef test_b(): ...\n\ndef helper(): ...\n")
    assert counted(path) == (2, 1)
    path.write_text("pytestmark = pytest.mark.alone\n" + path.read_text())
    assert counted(path) == (2, 2)


def test_every_room_keeps_quick_tests() -> None:
    """What ``make quick`` leaves out is the smaller part of each room."""
    rooms: dict[str, tuple[int, int]] = {}
    for path in TESTS.rglob("test_*.py"):
        name = path.relative_to(TESTS).parts[0]
        (count, left_out), (known, before) = counted(path), rooms.get(name, (0, 0))
        rooms[name] = (known + count, before + left_out)
    folders = {name: each for name, each in rooms.items() if not name.endswith(".py")}
    assert len(folders) > 10
    assert {name: each for name, each in folders.items() if each[1] * 2 > each[0]} == {}


def test_coverage_is_told_by_room_and_the_worst_comes_first() -> None:
    files = {
        ROOT / "ttscompile" / "artifact" / "load.py": (10, 9),
        ROOT / "ttscompile" / "artifact" / "deep" / "more.py": (10, 8),
        ROOT / "ttscompile" / "driver.py": (20, 10),
        ROOT / "runtimes" / "executor" / "door.py": (60, 60),
        ROOT / "passes" / "__init__.py": (0, 0),
    }
    assert [room(path) for path in files] == ["artifact", "artifact", "driver", "runtimes", "passes"]
    rooms = by_room(files)
    assert rooms == {"driver": (20, 10), "artifact": (20, 17), "runtimes": (60, 60)}
    assert list(rooms) == ["driver", "artifact", "runtimes"]
    text, reached = table(rooms, 87.0)
    rows = [line.split() for line in text.splitlines()]
    assert rows[1:] == [
        ["driver", "20", "10", "50.0%"],
        ["artifact", "20", "3", "85.0%"],
        ["runtimes", "60", "0", "100.0%"],
        ["all", "100", "13", "87.0%"],
        ["at", "least", "87", "%"],
    ]
    assert reached
    assert table(rooms, 87.1)[0].endswith("BELOW 87.1 %") and not table(rooms, 87.1)[1]


@pytest.mark.slow
def test_the_first_case_of_each_quick_test_is_measured(tmp_path: Path) -> None:
    """With the hook of the tree's own conftest, in processes of its own, as ``make test`` has them."""
    assert conftest.pytest_runtest_protocol is untraced.pytest_runtest_protocol
    (tmp_path / "measured.py").write_text(
        "def quick(first):\n    if first:\n        return 1\n    return 0\n\n\ndef slow():\n    return 2\n"
    )
    (tmp_path / "test_it.py").write_text(
        "import pytest, measured\n\n\n"
        "@pytest.mark.parametrize('first', [1, 0])\ndef test_a(first):\n    assert measured.quick(first) == first\n\n\n"
        "@pytest.mark.slow\ndef test_b():\n    assert measured.slow() == 2\n"
    )
    words = ["-m", "pytest", "-q", "-n", "1", "-p", "tests.untraced", "--rootdir", ROOT, "-c", ROOT / "pyproject.toml"]
    words += [
        "--cov",
        tmp_path,
        "--cov-report=term-missing",
        "--cov-config=/dev/null",
        "-p",
        "no:cacheprovider",
        tmp_path,
    ]
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = [line for line in done.stdout.splitlines() if line.startswith("measured.py")]
    assert "".join(row.split("%")[1].split()) == "4,8", "what the second case and slow() run is not seen"
