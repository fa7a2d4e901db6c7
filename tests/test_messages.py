"""What errors say: at most three lines, and no name that does not exist."""

from __future__ import annotations

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import click
import pytest

import ttscompile
from ttscompile.cli import main

from .imports import modules
from .structure import FLOORS

ROOT = Path(__file__).resolve().parents[1]

LINE, LINES = 120, 3
HOLE = 12
"""Characters that a value in a message counts for."""

FOREIGN = {
    "--dataset.video": "LeRobot's",
    "--force-reinstall": "pip's",
    "--json": "python -m ttscompile.doctor, and commands",
}
"""Options in messages that are not a command's of ttscompile."""


def text_of(node: ast.expr) -> str:
    """A message as it is written, with a dash for each character that a value counts for."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) if isinstance(part, ast.Constant) else "_" * HOLE for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    return ""


def raised(source: str) -> list[tuple[int, str]]:
    """Line and message of every error that a module raises, or makes for another to raise."""
    return [
        (node.lineno, text_of(node.args[0]))
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and node.args and ast.unparse(node.func).endswith("Error")
    ]


@cache
def messages() -> list[tuple[str, str]]:
    """Where each stands, and its text."""
    found = ((name, raised(path.read_text())) for name, path in modules(ROOT).items())
    return [(f"{name}:{line}", text) for name, own in found for line, text in own]


def lines_of(text: str) -> int:
    return sum(max(-(-len(line) // LINE), 1) for line in text.splitlines())


def stale(text: str) -> list[str]:
    """Names in a message that do not exist: of this package, of its commands, of their options."""
    rooms = "|".join(name for floor in FLOORS for name in floor if not name.startswith("_"))
    names = [name for name in re.findall(rf"\b(?:{rooms})(?:\.[A-Za-z_]\w*)+", text) if not exists(name)]
    commands = [name for name in re.findall(r"'ttscompile ([a-z]+)", text) if name not in main.commands]
    known = {option for command in main.commands.values() for each in command.params for option in each.opts}
    options = [
        name for name in re.findall(r"(?<![\w-])--[a-z][a-z.-]*[a-z]", text) if name not in known | FOREIGN.keys()
    ]
    return [*names, *commands, *options]


def exists(name: str) -> bool:
    """Whether a dotted name, with or without the package before it, is a module or in one."""
    module, *rest = name.removeprefix("ttscompile.").split(".")
    found: object = ttscompile
    path = "ttscompile"
    for part in (module, *rest) if name != "ttscompile" else ():
        path = f"{path}.{part}"
        try:
            found = getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(path)
            except ModuleNotFoundError:
                return False
    return True


def test_an_error_takes_at_most_three_lines() -> None:
    assert len(messages()) > 400, "the walk over the source found hardly anything"
    assert {where: text for where, text in messages() if lines_of(text) > LINES} == {}


def test_an_error_names_nothing_that_does_not_exist() -> None:
    assert {where: names for where, text in messages() if (names := stale(text))} == {}


@pytest.mark.parametrize(
    "text",
    ["driver.compile_module(x)", "see ttscompile.core.spec.Nothing", "Run 'ttscompile plan DIR'.", "Give --threadz 1."],
)
def test_a_stale_name_is_found(text: str) -> None:
    assert len(stale(text)) == 1


def test_a_message_is_counted_with_its_values() -> None:
    ((_, text),) = raised("raise SomeError(f'{path}: is wrong' + \" here\")")
    assert text == "_" * HOLE + ": is wrong here"
    assert (lines_of("a" * 360), lines_of("a" * 361), lines_of("a\nb\nc\nd")) == (3, 4, 4)


@pytest.mark.parametrize("name", sorted(main.commands))
def test_help_is_whole_sentences(name: str) -> None:
    command = main.commands[name]
    options = [each for each in command.params if isinstance(each, click.Option)]
    for text in [command.help, *(each.help for each in options)]:
        assert text is not None, "an option without a word of help"
        assert re.match(r"[A-Z]|bf16|rk4", text), text
        assert text.rstrip().endswith("."), text
