"""What README and the site show is true: marked commands print it, Python examples run, and every option exists."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

from tests.passes.test_pipeline import MODULES, spec
from ttscompile.artifact.write import update_calibration
from ttscompile.cli import main
from ttscompile.lattice import uniform_plan
from ttscompile.record_golden import record_plans

ROOT = Path(__file__).resolve().parents[1]


def load(path: Path, name: str) -> ModuleType:
    """A script that is no part of a package."""
    found = importlib.util.spec_from_file_location(name, path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module
    found.loader.exec_module(module)
    return module


examples = load(ROOT / "docs" / "examples.py", "docs_examples")
PAGES = examples.pages()
BLOCKS = [block for page in PAGES for block in examples.blocks(page)]
SCORE = {"error": 3.5, "error_p90": 6.9, "sparsity": 0.95, "flops_sparsity": 0.95, "flops_saved": 0.95}
PYTHON_PAGES = sorted({b.page for b in BLOCKS if b.language == "python" and b.page.name != "CONTRIBUTING.md"})
"""The guide's two files are run by a test of their own."""


@pytest.fixture(scope="module")
def folder(compiled_pusht: Path, pusht_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages speak of: a checkpoint, an artifact with plans, recorded calls."""
    place = tmp_path_factory.mktemp("docs")
    shutil.copytree(compiled_pusht, place / "compiled")
    full = {"safe": 10, "schedule": 5, "uniform": 5}
    plans = {name: uniform_plan(100, 24, steps) for name, steps in full.items()}
    record = {
        "strategy": "tts",
        "seed": 0,
        "target_sparsity": 0.95,
        "default_plan": "schedule",
        "plans": dict.fromkeys(full, SCORE),
        "episodes": {"calibration": list(range(12)), "validation": [12, 13, 14, 15]},
        "calls": {"calibration": 160, "validation": 128},
        "intervals": 1,
        "stopped": "time limit",
        "budget": {"target_sparsity": 0.95, "cells": 120},
        "steps": [0, 20, 40, 60, 80],
        "switches": 0,
        "named_steps": {"safe": list(range(0, 100, 10))},
        "skipped": {"fast": "the time limit left none for it"},
    }
    update_calibration(place / "compiled", None, plans, "schedule", record, golden=record_plans)
    rng = np.random.default_rng(0)
    calls = rng.uniform(100, 400, (6, 2, 20)).astype(np.float32)
    np.savez(place / "calls.npz", obs=calls, episode_ends=np.array([4, 6]))
    (place / "comparison.json").write_text("{}")
    (place / "policy.ckpt").symlink_to(pusht_checkpoint)
    (place / "examples").symlink_to(ROOT / "examples")
    return place


@pytest.fixture
def here(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder for one page, as the current directory. Files are replaced, never written to: links do."""
    place = tmp_path / "here"
    shutil.copytree(folder, place, copy_function=lambda a, b: Path(b).hardlink_to(a), symlinks=True)
    monkeypatch.chdir(place)
    return place


class Times:
    """True so many times, then false: the condition of a control loop."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __bool__(self) -> bool:
        self.left -= 1
        if self.left >= 0:
            return True
        self.left = 2  # for the next loop of the page
        return False


class Robot:
    """Takes actions of two numbers."""

    def move(self, action: np.ndarray) -> None:
        assert action.shape == (2,)
        assert np.isfinite(action).all()


def given() -> dict[str, Any]:
    """What examples take for granted: a robot, observations, a network of the reader's own."""
    return {
        "__name__": "__main__",
        "running": Times(2),
        "window": np.full((1, 2, 20), 256, np.float32),
        "frame": np.full(20, 256, np.float32),
        "robot": Robot(),
        "wait_for_the_next_tick": lambda: None,
        "module": MODULES["adaLN"]().eval(),
        "spec": spec(),
    }


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.name)
def test_python_examples_run(page: Path, here: Path) -> None:
    names = given()
    for block in BLOCKS:
        if block.page == page and block.language == "python":
            code = "\n" * block.line + "\n".join(block.lines)  # tracebacks have the page's line numbers
            exec(compile(code, str(page), "exec"), names)


@pytest.mark.parametrize(
    "block", [b for b in BLOCKS if b.marked and not b.slow and b.language == "console"], ids=lambda block: block.name
)
def test_commands_print_what_is_shown(block: Any, here: Path) -> None:
    for command in examples.commands(block):
        words = command.words()
        assert words[0] == "ttscompile"
        result = CliRunner().invoke(main, words[1:], prog_name="ttscompile", catch_exceptions=False)
        assert result.exit_code == 0, f"{block.name}: {result.stderr}"
        assert command.output, f"{block.name}: nothing is shown; run docs/examples.py"
        missing = examples.missing(command.output, result.output.splitlines())
        assert missing == [], f"{block.name}: this is not printed any more; run docs/examples.py"


COMMANDS = [command for block in BLOCKS if block.language == "console" for command in examples.commands(block)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.text[:60])
def test_every_command_that_is_shown_exists_with_its_options(command: Any) -> None:
    words = [word for word in command.words() if word != "|"]
    check: dict[str, Callable[[list[str]], None]] = {
        "ttscompile": check_ttscompile,
        "make": check_make,
        "pip": check_pip,
        "python": check_python,
    }
    words[0] = Path(words[0]).name
    if words[0] in check:
        check[words[0]](words[1:])
    else:
        known = {"source", "cd", "cp", "git", "pytest", "ruff", "mkdocs"}
        assert words[0] in known, f"{command.block.name}: {command.text}"


def check_ttscompile(words: list[str]) -> None:
    """The command parses; files need not exist."""
    name, *arguments = words
    if name == "--help":
        return
    assert name in main.commands, name
    try:
        main.commands[name].make_context(name, arguments)
    except click.BadParameter as error:
        if "does not exist" not in error.message:
            raise


def check_make(words: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in (word for word in words if "=" not in word):
        assert re.search(rf"^({re.escape(target)}|\$\(READY\)):", makefile, re.MULTILINE), target
        assert not target.startswith(".venv") or "$(VENV)/installed.stamp" in makefile


def check_pip(words: list[str]) -> None:
    assert words[0] == "install"
    extras = re.findall(r"^(\w+) = \[$", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    for word in words[1:]:
        if found := re.fullmatch(r"ttscompile\[(\w+)\]", word):
            assert found[1] in extras, word


def check_python(words: list[str]) -> None:
    if words[0] == "-m":
        assert importlib.util.find_spec(words[1]) is not None, words
        return
    script = ROOT / words[0]
    assert script.is_file(), words[0]
    sources = "".join(path.read_text() for path in script.parent.glob("*.py"))
    for option in (word for word in words[1:] if word.startswith("-")):
        assert f'"{option}"' in sources, f"{words[0]} has no option {option}"


def test_commands_are_found_everywhere() -> None:
    """The walk over the pages sees the README, and marks."""
    assert len(COMMANDS) > 20
    assert ROOT / "README.md" in {command.block.page for command in COMMANDS}
    assert sum(block.marked for block in BLOCKS) >= 5


def test_the_comparison_of_outputs_sees_what_is_gone() -> None:
    printed = ["  schedule (default)   31.9 ms   95.0%", "  dense   553 ms   0.0%"]
    assert examples.missing(["  schedule (default)   40.1 ms   94.9%", "...", ""], printed) == []
    assert examples.missing(["  pruner (default)   made for each observation   95.0%"], printed) != []
    assert examples.renewed(["dense 1 ms 1%", "..."], printed) == [printed[1], "..."]
    assert examples.renewed([], printed) == printed


def test_the_lattice_is_drawn_by_its_script(tmp_path: Path) -> None:
    from PIL import Image

    load(ROOT / "docs" / "pictures" / "lattice.py", "docs_lattice").draw(tmp_path / "lattice.png")
    made, kept = (Image.open(p).convert("RGB") for p in (tmp_path / "lattice.png", ROOT / "docs/pictures/lattice.png"))
    assert made.size == kept.size
    difference = np.abs(np.asarray(made, np.int16) - np.asarray(kept, np.int16))
    assert difference.mean() < 2, "the picture in the tree is not the script's: python docs/pictures/lattice.py"


def test_links_between_pages_lead_somewhere() -> None:
    broken = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in link and not (page.parent / link).exists():
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert broken == []


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    listed = set(re.findall(r"[\w/-]+\.md", text))
    assert listed == {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}


def test_the_pass_of_the_contributing_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both files as they stand in the guide, in the place that it gives them."""
    written = [block for block in examples.blocks(ROOT / "CONTRIBUTING.md") if block.language == "python"]
    assert len(written) == 2
    names = ("ttscompile.passes.drop_unit_scale", "contributed_test")
    files = [tmp_path / "drop_unit_scale.py", tmp_path / "test_drop_unit_scale.py"]
    for file, block in zip(files, written, strict=True):
        file.write_text("\n".join(block.lines) + "\n")
    for name in names:
        monkeypatch.setitem(sys.modules, name, None)  # taken out again afterwards
    load(files[0], names[0])
    test = load(files[1], names[1])
    test.test_a_multiplication_by_one_is_gone_and_the_numbers_stay()
    near_misses = test.test_what_is_not_by_one_or_is_an_output_stays
    cases = near_misses.pytestmark[0].args[1]
    assert len(cases) == 2
    for graph in cases:
        near_misses(graph)


def test_the_site_is_built_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    reference = (tmp_path / "site" / "reference" / "passes.html").read_text()
    assert "ttscompile.passes.hoist.Hoist" in reference, "passes/ is read as it is installed"
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text()
        loaded = re.findall(r"<(?:script|img|iframe)[^>]*\ssrc=\"?([^\"\s>]+)", text)
        loaded += re.findall(r"<link[^>]*rel=\"?(?:stylesheet|preload|preconnect)\"?[^>]*href=\"?([^\"\s>]+)", text)
        assert loaded
        assert [address for address in loaded if "//" in address] == [], page
