"""The commands and Python examples that the pages show: found, compared with what really happens, and written anew.

    python docs/examples.py FOLDER [PAGE...]

runs, in FOLDER, the console blocks under ``<!-- run -->`` as they stand, and writes what they print into the pages.
FOLDER holds what the pages speak of: ``policy.ckpt``, a link to ``examples``, and, for all pages but the tutorial, what
the tutorial makes: ``compiled/`` and ``calls.npz``. So the tutorial comes first; it calibrates, for many minutes.

``tests/test_docs.py`` follows the pages as a reader would, with shorter runs: all Python blocks and all commands,
whether they are marked or not, but those that it names with a reason.
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
_MARK = re.compile(r"^\s*<!-- run -->\s*$")
_NUMBER = re.compile(r"\b[0-9a-f]{12,64}\b|\d[\d.,]*(?:e[+-]?\d+)?")  # an identity, too
_NUMBERS = re.compile(r"#(?:, #)+")  # a list of any length
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
        marked: what it shows is written anew.
        lines: without the fences.
    """

    page: Path
    line: int
    language: str
    marked: bool
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
    found, lines, i, marked = [], page.read_text().splitlines(), 0, False
    while i < len(lines):
        fence = _FENCE.match(lines[i])
        if fence is not None:
            end = next(j for j in range(i + 1, len(lines)) if lines[j].strip() == "```")
            inside = tuple(line.removeprefix(fence["indent"]) for line in lines[i + 1 : end])
            found.append(Block(page, i + 1, fence["language"], marked, inside))
            i = end
        marked = fence is None and _MARK.match(lines[i]) is not None
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
    return _NUMBERS.sub("#", _NUMBER.sub("#", _RULE.sub(" ", line))).split()


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


def headers(lines: Sequence[str]) -> list[str]:
    """Lines with a rule below: the columns of tables, or the last line of their names."""
    rules = [bool(line.strip()) and not words_of(line) for line in lines]
    return [line for line, below in zip(lines, rules[1:], strict=False) if below and words_of(line)]


def missing(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """Lines that are shown and that nothing printed resembles, and columns of tables that are not exactly printed."""
    wanted = [line for line in shown if line.strip() != ELIDED and words_of(line)]
    gone = [line for line in wanted if max((likeness(line, other) for other in printed), default=0) < ALIKE]
    columns = [words_of(line) for line in headers(printed)]
    return gone + [line for line in headers(shown) if line not in gone and words_of(line) not in columns]


def renewed(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """What to show: all that was printed, or, where parts are left out, the lines most like those shown, in order."""
    lines = [line.rstrip() for line in printed]
    while lines and not lines[0]:
        lines.pop(0)
    while lines and not lines[-1]:
        lines.pop()
    if not any(line.strip() == ELIDED for line in shown):
        return lines
    kept, at = [], 0
    rest = [line for line in lines if line.strip()]
    for line in shown:
        if line.strip() == ELIDED or not line.strip() or at == len(rest):
            kept.append(line)
            continue
        # Of equals the next one: lines come in the order in which they are shown.
        found = [(likeness(line, other), likeness(other, line)) for other in rest[at:]]
        if max(found)[0] >= ALIKE:
            at += found.index(max(found)) + 1
            kept.append(rest[at - 1])
    return kept


def run(command: Command, folder: Path, extra: Sequence[str] = ()) -> str:
    """What a command prints in a folder, standard error first.

    Args:
        command: as it is shown.
        folder: to run it in.
        extra: further options.

    Raises:
        RuntimeError: it failed.
    """
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    # The pages are this project's own: what they tell readers to type is typed here.
    result = subprocess.run(  # noqa: S603
        [*command.words(), *extra],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        raise RuntimeError(f"{command.block.name}: {command.text}\n{result.stderr}{result.stdout}")
    return result.stderr + result.stdout


def write(folder: Path, chosen: Sequence[Path]) -> None:
    """Run the marked blocks of pages in a folder, in order, and put what they print into the pages."""
    for page in chosen:
        lines, written, done = page.read_text().splitlines(), [], 0
        for block in blocks(page):
            if not (block.marked and block.language == "console"):
                continue
            written += lines[done : block.line]
            done = block.line + len(block.lines)
            for command in commands(block):
                sys.stderr.write(f"{block.name}: {command.text}\n")
                written += block.lines[command.line : command.line + _length(block, command)]
                written += renewed(command.output, run(command, folder).splitlines())
        page.write_text("\n".join([*written, *lines[done:]]) + "\n")


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
