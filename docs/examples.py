"""The commands and Python examples that the pages show: found, compared with what really happens, and written anew.

    python docs/examples.py FOLDER [PAGE...]

runs, in FOLDER, the console blocks under ``<!-- run -->`` and ``<!-- run: slow -->``, and writes what they print into
the pages. FOLDER holds what the pages speak of: ``policy.ckpt``, ``compiled/`` (calibrated), ``calls.npz``.
``tests/test_docs.py`` runs the first kind and all Python blocks, and checks that the options of all commands exist.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_RUN = ("design.md", "decisions.md")
"""Pages whose examples are a contract, or history."""

_FENCE = re.compile(r"^(?P<indent>\s*)```(?P<language>[\w-]*)\s*$")
_MARK = re.compile(r"^\s*<!-- run(?P<slow>: slow)? -->\s*$")
_NUMBER = re.compile(r"\b[0-9a-f]{12,64}\b|\d[\d.,]*(?:e[+-]?\d+)?")  # an identity, too
_RULE = re.compile(r"[─━┃│┏┓┗┛┡┩╇┳└┘┴┼├┤]+")
ELIDED = "..."
ALIKE = 0.6
"""Share of the words of a line that is shown which a line that was really printed must have."""


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: file.
        line: number of its first line, from 0.
        language: after the fence.
        marked: to be run.
        slow: written anew only, not run by the tests.
        lines: without the fences.
    """

    page: Path
    line: int
    language: str
    marked: bool
    slow: bool
    lines: tuple[str, ...]

    @property
    def name(self) -> str:
        """For messages: file and line, from 1."""
        return f"{self.page.relative_to(ROOT)}:{self.line + 1}"


@dataclass(frozen=True)
class Command:
    """A command line of a console block, and what is shown below it."""

    block: Block
    line: int
    text: str
    output: tuple[str, ...]

    def words(self) -> list[str]:
        """As a shell would split it, without comments."""
        return shlex.split(self.text, comments=True)


def pages() -> list[Path]:
    """README, CONTRIBUTING and the site's pages, but those whose examples are not run."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in found if page.name not in NOT_RUN]


def blocks(page: Path) -> list[Block]:
    """Fenced blocks of a page, in order."""
    found, lines, i, mark = [], page.read_text().splitlines(), 0, None
    while i < len(lines):
        fence = _FENCE.match(lines[i])
        if fence is not None:
            slow = mark is not None and mark["slow"] is not None
            end = next(j for j in range(i + 1, len(lines)) if lines[j].strip() == "```")
            inside = tuple(line.removeprefix(fence["indent"]) for line in lines[i + 1 : end])
            found.append(Block(page, i + 1, fence["language"], mark is not None, slow, inside))
            i = end
        mark = _MARK.match(lines[i]) if fence is None else None
        i += 1
    return found


def commands(block: Block) -> Iterator[Command]:
    """Lines that start with ``$``, joined where a backslash continues them, each with its output."""
    i = 0
    while i < len(block.lines):
        if not block.lines[i].startswith("$ "):
            i += 1
            continue
        start, text = i, block.lines[i][2:]
        while text.endswith("\\"):
            i += 1
            text = text[:-1] + block.lines[i].strip()
        i += 1
        output = []
        while i < len(block.lines) and not block.lines[i].startswith("$ "):
            output.append(block.lines[i])
            i += 1
        yield Command(block, start, text, tuple(output))


def words_of(line: str) -> list[str]:
    """What of a line does not change from machine to machine: its words, with numbers made equal."""
    return _NUMBER.sub("#", _RULE.sub(" ", line)).split()


def likeness(shown: str, printed: str) -> float:
    """Share of the shown line's words that the printed line has, 1 for a line without words."""
    wanted, there = words_of(shown), words_of(printed)
    if not wanted:
        return 1.0
    kept = 0
    for word in wanted:
        if word in there:
            there.remove(word)
            kept += 1
    return kept / len(wanted)


def missing(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """Lines that are shown and that nothing printed resembles."""
    wanted = [line for line in shown if line.strip() != ELIDED and words_of(line)]
    return [line for line in wanted if max((likeness(line, other) for other in printed), default=0) < ALIKE]


def renewed(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """What to show: all that was printed, or, where parts are left out, the lines most like those that were shown."""
    lines = [line.rstrip() for line in printed]
    while lines and not lines[0]:
        lines.pop(0)
    while lines and not lines[-1]:
        lines.pop()
    if not any(line.strip() == ELIDED for line in shown):
        return lines
    kept = []
    for line in shown:
        if line.strip() == ELIDED or not line.strip() or not lines:
            kept.append(line)
        else:
            kept.append(max(lines, key=lambda other: (likeness(line, other), likeness(other, line))))
    return kept


def write(folder: Path, chosen: Sequence[Path]) -> None:
    """Run the marked blocks of pages in a folder and put what they print into the pages."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    for page in chosen:
        lines = page.read_text().splitlines()
        for block in reversed([block for block in blocks(page) if block.marked and block.language == "console"]):
            made: list[str] = []
            for command in commands(block):
                sys.stderr.write(f"{block.name}: {command.text}\n")
                # The pages are this project's own: what they tell readers to type is typed here.
                result = subprocess.run(  # noqa: S603
                    command.words(), cwd=folder, env=environment, capture_output=True, text=True, check=False
                )
                if result.returncode:
                    raise SystemExit(f"{block.name}: {command.text}\n{result.stderr}")
                told = result.stderr + result.stdout  # as a terminal would show them
                source = block.lines[command.line : command.line + _length(block, command)]
                made += [*source, *renewed(command.output, told.splitlines())]
            lines[block.line : block.line + len(block.lines)] = made
        page.write_text("\n".join(lines) + "\n")


def _length(block: Block, command: Command) -> int:
    """Lines of a command."""
    end = command.line
    while block.lines[end].endswith("\\"):
        end += 1
    return end - command.line + 1


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    write(Path(sys.argv[1]), [Path(name).resolve() for name in sys.argv[2:]] or pages())
