"""Where commands, options and names went that are gone: the page has each, and what it names instead is there."""

from __future__ import annotations

import inspect
import re
from itertools import chain
from typing import Any

import click
import pytest

import ttscompile
from tests.commands_before import BEFORE, LATER_NAMES, NAMES, USES
from tests.pages import ROOT
from ttscompile.calibration.pipeline import CalibrationResult
from ttscompile.cli import main
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.copies import FleetSettings
from ttscompile.serving.fleet import FleetServer

COMMANDS, OPTIONS, PYTHON = (
    [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| `")]
    for part in re.split(
        r"\| (?:Option|Python) \|",
        (ROOT / "docs" / "reference" / "commands.md").read_text().partition("## Where things went")[2],
    )
)
SERVING = {"ServerLimits": ServerLimits, "FleetSettings": FleetSettings, "FleetServer": FleetServer}
CHANGED = {("--observation", "inspect"), ("--calls", "compare"), ("--max-distance", "warm-start")}
CHANGED |= {("--max-action-error", "reuse-tokens"), ("--precision", "convert")}
CHANGED |= {("--seed", "compare"), ("--plan", "distill"), ("--calls", "reuse-tokens"), ("--calls", "warm-start")}
"""What has a row although an option of that name is there: it means something else, or takes fewer words."""


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def in_python(name: str) -> Any:
    return SERVING.get(name) or getattr(ttscompile, name)


def arguments(call: str) -> tuple[str, set[str]]:
    """The function, or class, of ``name(argument=..)``, and the arguments that are named."""
    name, _, given = call.removeprefix("ttscompile.").partition("(")
    return name, set(re.findall(r"(\w+)=", given))


def options_of(command: str) -> set[str]:
    return {name for each in main.commands[command].params if isinstance(each, click.Option) for name in each.opts}


ROWS = [(name.split()[0], of) for names, ofs, _ in OPTIONS for name in quoted(names) for of in quoted(ofs)]
PLACE = {quoted(before)[0]: quoted(now)[0].split() for before, now in COMMANDS}
"""The words of the first thing that is named in place of a command: it begins with another command, or with python."""


def test_every_command_that_is_gone_has_a_row() -> None:
    assert sorted(PLACE) == sorted(set(BEFORE) - set(main.commands))
    assert {words[0] for words in PLACE.values()} <= {*main.commands, "python"}


@pytest.mark.parametrize("command", sorted(BEFORE))
def test_every_option_that_is_gone_has_a_row(command: str) -> None:
    words = PLACE.get(command, [command])
    if words[0] == "python":
        script = (ROOT / words[1]).read_text()
        known = {name for name in BEFORE[command] if f'"{name}"' in script}
        known |= {"--trajectories", "--observation"} if "@trajectories_options()" in script else set()
    else:
        known = options_of(words[0])
    rows = {name for name, of in ROWS if of == command}
    assert set(BEFORE[command]) - known <= rows
    changed = {name for name, of in CHANGED if of == command}
    assert rows & known == changed & known
    assert changed <= rows


def test_rows_are_of_what_there_was() -> None:
    """Or of what there was for some days between: a command that is there still, and has no such option."""
    for name, of in ROWS:
        assert name in BEFORE[of] or name not in options_of(of), (name, of)
    assert len(set(ROWS)) == len(ROWS)
    first = [quoted(names)[0] for names, _, _ in OPTIONS]
    assert first == sorted(first)


@pytest.mark.parametrize("now", [row[-1] for row in COMMANDS + OPTIONS + PYTHON], ids=lambda now: now[:50])
def test_what_took_its_place_is_there(now: str) -> None:
    for words in map(str.split, quoted(now)):
        command = words[1] if words[0] == "ttscompile" else words[0]
        if command in main.commands and len(words) > 1:
            assert {word for word in words if word.startswith("-")} <= options_of(command), now
    for file in re.findall(r"examples/[\w/]+\.py", now):
        text = (ROOT / file).read_text()
        for option in re.findall(r"`(--[\w-]+)` of `examples", now):
            assert f'"{option}"' in text or f"{option.strip('-')}_option" in text, (option, file)
    for call in (each for each in quoted(now) if "=" in each and "(" in each):
        name, given = arguments(call)
        assert given <= set(inspect.signature(in_python(name)).parameters), now
    for holder, attribute in re.findall(r"`(Policy\w+|SamplerTable)\.(\w+)", now):
        assert hasattr(in_python(holder), attribute), now


def test_names_of_python_that_are_gone_have_a_row() -> None:
    assert set(ttscompile.__all__) >= NAMES
    named = set(chain.from_iterable(quoted(before) for before, _ in PYTHON))
    assert LATER_NAMES - set(ttscompile.__all__) == {each for each in named if each.isidentifier()}
    uses = {re.sub(r"=[^)]*", "=", each) for each in named if not each.isidentifier()}
    assert uses == USES
    for name, given in (arguments(each) for each in uses if "(" in each):
        assert not given & set(inspect.signature(in_python(name)).parameters)
    for holder, attribute in (each.split(".") for each in uses if "(" not in each):
        assert not hasattr(in_python(holder), attribute)
    assert inspect.signature(ttscompile.calibrate).return_annotation in (CalibrationResult, "CalibrationResult")
