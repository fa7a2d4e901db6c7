"""What README and the site show is true: every page is followed as a reader would, in order, with shorter runs."""

from __future__ import annotations

import contextlib
import importlib
import json
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
import zarr
from click.testing import CliRunner

import ttscompile
from tests.commands_of_docs import NOT_RUN, SHORTER
from tests.pages import EXTENDING, ROOT, examples, load
from tests.passes.modules import MODULES, spec
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import load_episodes
from ttscompile.cli import main

PAGES = examples.pages()
BLOCKS = [block for page in PAGES for block in examples.blocks(page)]
TUTORIAL = ROOT / "docs" / "tutorial.md"
COMMANDS = [command for block in BLOCKS if block.language == "console" for command in examples.commands(block)]
COMMANDS.sort(key=lambda command: command.block.page != TUTORIAL)
FOLLOWED = sorted(
    {b.page for b in BLOCKS if b.language in ("console", "python") and b.page.parent != EXTENDING}
    - {ROOT / "CONTRIBUTING.md"}
)
"""The commands of the guides are in ``NOT_RUN``; the files that the worked examples show have tests of their own."""


@pytest.fixture(scope="module")
def folder(whole_layer_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages after the tutorial speak of, from the first of the policy's eight layers."""
    place = tmp_path_factory.mktemp("docs")
    shutil.copy(whole_layer_checkpoint, place / "policy.ckpt")
    (place / "examples").symlink_to(ROOT / "examples")
    rng = np.random.default_rng(0)
    calls = rng.uniform(100, 400, (60, 2, 20)).astype(np.float32)
    np.savez(place / "calls.npz", obs=calls, episode_ends=np.array([20, 40, 60]))
    recording = zarr.open_group(place / "replay.zarr", mode="w")
    frames = {"data/keypoint": (40, 9, 2), "data/state": (40, 5)}
    for name, shape in frames.items():
        recording.create_array(name, data=rng.uniform(100, 400, shape).astype(np.float32))
    recording.create_array("meta/episode_ends", data=np.array([20, 40]))
    point = {"series": "interval", "name": "0.8", "distance": 20.0, "latency_ms": 3.0}
    (place / "comparison.json").write_text(json.dumps({"comparison": {"points": [point]}}))
    for words in (
        ["convert", "policy.ckpt", "-o", "compiled"],
        ["calibrate", "compiled", "--trajectories", "calls.npz"],
    ):
        with contextlib.chdir(place):
            ttscompile_prints([*words, *SHORTER[words[0]].split()])
    return place


def ttscompile_prints(words: list[str]) -> str:
    """What the command line prints; it must succeed. A search of a moment finds a doubtful plan, which is told of."""
    result = CliRunner().invoke(main, words, prog_name="ttscompile", catch_exceptions=False)
    told = {"calibrate": "scores may fall", "verify": "FAILED at distance"}
    doubtful = words[0] in told and told[words[0]] in result.output
    assert result.exit_code == doubtful, f"{' '.join(words)}: {result.output}"
    return result.output


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


def reason(command: Any) -> str | None:
    """Why a command is not run here; None for one that is."""
    return next((why for start, why in NOT_RUN.items() if f"{command.text} ".startswith(start)), None)


def elsewhere(command: Any) -> bool:
    """Whether a longer command that starts so, or the same before, is run: it need not be, but for its output."""
    words = command.words()
    own = next(i for i, other in enumerate(COMMANDS) if other is command)
    return not any(command.output) and any(
        other.words()[: len(words)] == words and (len(other.words()) > len(words) or i < own)
        for i, other in enumerate(COMMANDS)
        if reason(other) is None
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*learned plan:UserWarning")  # pages convert into the artifact that is there
@pytest.mark.parametrize("page", FOLLOWED, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_can_be_followed(page: Path, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: Any) -> None:
    if page == TUTORIAL:  # makes everything itself, from the policy of the example
        (tmp_path / "examples" / "pusht").mkdir(parents=True)
        (tmp_path / "examples" / "evaluation").symlink_to(ROOT / "examples" / "evaluation")
        for file in (ROOT / "examples" / "pusht").iterdir():
            layer = request.getfixturevalue("whole_layer_checkpoint")
            (tmp_path / "examples" / "pusht" / file.name).symlink_to(layer if file.suffix == ".ckpt" else file)
        monkeypatch.chdir(tmp_path)
    else:
        request.getfixturevalue("here")
    names = given()
    for block in (block for block in BLOCKS if block.page == page):
        if block.language == "python":
            code = "\n" * block.line + "\n".join(block.lines)  # tracebacks have the page's line numbers
            exec(compile(code, str(page), "exec"), names)
        elif block.language == "console":
            follow(block)


@pytest.mark.slow
def test_the_recording_that_the_tutorial_writes_by_hand_is_read(
    compiled_layer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = ["\n".join(block.lines) for block in BLOCKS if block.page == TUTORIAL and block.language == "python"]
    monkeypatch.chdir(tmp_path)
    exec(next(each for each in code if "np.savez" in each), {})
    episodes = load_episodes(load_artifact(compiled_layer).manifest.spec, ["calls.npz"], None)
    assert [each.calls for each in episodes] == [30] * 16


def follow(block: Any) -> None:
    """Run the commands of a block here, and hold what they print against what is shown."""
    for command in [command for command in COMMANDS if command.block is block]:
        assert block.marked or not any(command.output), f"{block.name}: output without <!-- run --> above the block"
        if reason(command) is not None or elsewhere(command):
            assert not block.marked, f"{block.name}: {command.text} is not run by the tests"
            continue
        words = command.words()
        extra = SHORTER.get(Path(words[1]).name, "").split()
        printed = (
            ttscompile_prints([*words[1:], *extra])
            if words[0] == "ttscompile"
            else examples.run(command, Path.cwd(), extra)
        )
        assert command.output or not block.marked, f"{block.name}: nothing is shown; run docs/examples.py"
        missing = examples.missing(command.output, printed.splitlines())
        assert missing == [], f"{block.name}: this is not printed any more; run docs/examples.py\n{printed}"


def test_no_reason_is_left_over() -> None:
    """Whatever is not run is on a page, and beside each of the pages some commands are run."""
    for start in NOT_RUN:
        assert any(f"{command.text} ".startswith(start) for command in COMMANDS), start
    assert sum(reason(command) is None for command in COMMANDS) >= 25


@pytest.mark.parametrize("command", [c for c in COMMANDS if reason(c)], ids=lambda command: command.text[:60])
def test_every_command_that_is_not_run_exists_with_its_options(command: Any) -> None:
    words = command.words()
    check: dict[str, Callable[[list[str]], None]] = {
        "ttscompile": check_ttscompile,
        "make": check_make,
        "pip": check_pip,
    }
    words[0] = Path(words[0]).name
    if words[0] in check:
        check[words[0]](words[1:])


def check_ttscompile(words: list[str]) -> None:
    """The command parses; files need not exist."""
    name, *arguments = words
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


def test_commands_are_found_everywhere() -> None:
    """The walk over the pages sees the README, and marks."""
    assert len(COMMANDS) > 20
    assert ROOT / "README.md" in {command.block.page for command in COMMANDS}
    assert sum(block.marked for block in BLOCKS) >= 5
    assert len(FOLLOWED) > 12


def test_the_comparison_of_outputs_sees_what_is_gone() -> None:
    printed = ["  schedule (default)   31.9 ms   95.0%", "  dense   553 ms   0.0%"]
    assert examples.missing(["  schedule (default)   40.1 ms   94.9%", "...", ""], printed) == []
    assert examples.missing(["  pruner (default)   made for each observation   95.0%"], printed) != []
    assert examples.renewed(["dense 1 ms 1%", "..."], printed) == [printed[1], "..."]
    assert examples.renewed(["was printed once", "dense 1 ms 1%", "..."], printed) == [printed[1], "..."]
    assert examples.missing(["computed steps 0, 54, 83"], ["computed steps 0"]) == []
    assert examples.renewed([], printed) == printed
    table = ["  plan   distance   ms", " ──────", "  dense   0.0   553"]
    assert examples.missing(table, ["  plan   distance   ms", " ────────", "  dense   0.1   60"]) == []
    assert examples.missing(table, ["  plan   distance   longest   ms", " ────────", "  dense   0.1   60"]) == table[:1]


def test_the_reference_shows_every_public_name() -> None:
    shown = set()
    for page in ("python.md", "errors.md"):
        for path in re.findall(r"^::: (\S+)", (ROOT / "docs" / "reference" / page).read_text(), re.MULTILINE):
            parent, _, name = path.rpartition(".")
            thing = getattr(importlib.import_module(parent), name, None) or importlib.import_module(path)
            inside = vars(thing).values() if isinstance(thing, ModuleType) else ()
            shown |= {id(thing), *(id(each) for each in inside if getattr(each, "__module__", None) == path)}
    names = [name for name in ttscompile.__all__ if name != "__version__"]
    assert [name for name in names if id(getattr(ttscompile, name)) not in shown] == []


@pytest.mark.parametrize("name", ["distance", "equal_time", "lattice"])
def test_a_picture_is_drawn_by_its_script(tmp_path: Path, name: str) -> None:
    from PIL import Image

    drawn, folder = tmp_path / f"{name}.png", ROOT / "docs" / "pictures"
    load(folder / f"{name}.py", f"docs_{name}").draw(drawn)
    made, kept = (Image.open(p).convert("RGB") for p in (drawn, folder / f"{name}.png"))
    assert made.size == kept.size
    difference = np.abs(np.asarray(made, np.int16) - np.asarray(kept, np.int16))
    assert difference.mean() < 2, f"the picture in the tree is not the script's: python docs/pictures/{name}.py"


def headings(page: Path) -> set[str]:
    """What a link to a section of a page ends with."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", each) for each in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    return {re.sub(r"[^\w\- ]", "", each).strip().lower().replace(" ", "-") for each in plain}


def test_links_between_pages_lead_somewhere() -> None:
    broken = []
    for page in {*PAGES, *(ROOT / "docs").rglob("*.md")}:
        for link, section in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", page.read_text()):
            there = page.parent / link if link else page
            unknown = there.suffix == ".md" and section and there.exists() and section not in headings(there)
            if "://" not in link and (unknown or not there.exists()):
                broken.append(f"{page.relative_to(ROOT)}: {link}#{section}")
    assert broken == []


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    listed = set(re.findall(r"[\w/-]+\.md", text))
    assert listed == {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}


@pytest.mark.slow
def test_the_site_is_built_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
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
