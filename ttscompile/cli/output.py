"""What the commands share: where results and progress go, and how figures are written."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TypeVar

import click
from rich import box
from rich.console import Console
from rich.table import Table

from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.artifact.manifest import Manifest, abbreviated
from ttscompile.errors import TtscompileError
from ttscompile.measure.units import flops as flops
from ttscompile.measure.units import ms as ms
from ttscompile.measure.units import share as share
from ttscompile.report.page import Table as Made

Command = TypeVar("Command", bound=Callable[..., Any])

artifact_argument = click.argument("directory", type=click.Path(path_type=Path))
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document on standard output, and nothing else."
)


def count_option(name: str, help: str, *, default: int | None = 1, least: int = 1) -> Callable[[Command], Command]:
    """An option that takes a whole number of at least ``least``."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=default is not None, help=help)


_WIDTH = 110
"""Columns of a table that goes to a file or a pipe; a terminal's own width is used where there is one."""

_SCRIPTS_WIDTH = 150


def results(width: int = _WIDTH) -> Console:
    """Console for results, on standard output; names and paths are shown as they are, whatever brackets they have."""
    console = Console(highlight=False, markup=False, emoji=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, emoji=False, width=width)


def results_console() -> Console:
    """The same for scripts of ``examples``, whose tables are wider."""
    return results(_SCRIPTS_WIDTH)


def run(command: click.Command) -> None:
    """Run a script's command; an error of ttscompile is its message and exit status 2."""
    try:
        command()
    except TtscompileError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)


def progress() -> Console:
    """Console for progress and warnings, on standard error."""
    return Console(stderr=True, highlight=False, markup=False, emoji=False)


@contextmanager
def only_results_on_stdout() -> Iterator[None]:
    """Send to standard error what libraries print while they work."""
    with redirect_stdout(sys.stderr):
        yield


def print_json(document: Mapping[str, Any]) -> None:
    """Write one JSON document to standard output; NaN and infinity, which JSON has not, are null."""
    click.echo(json.dumps(_without_nan(document), indent=2, allow_nan=False))


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(*columns: str) -> Table:
    """A table whose first column is text and whose others are figures."""
    made = Table(box=box.SIMPLE_HEAD)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left", no_wrap=i == 0, overflow="fold")
    return made


def print_table(made: Made, console: Console) -> None:
    """A table of a report, if it has any rows."""
    if made.rows:
        shown = table(*made.head)
        for row in made.rows:
            shown.add_row(*row)
        console.print(shown)


def manifest_of(path: Path) -> Manifest:
    """Manifest of an artifact; in a directory nothing else is read and checked.

    Raises:
        ArtifactError: there is no artifact.
    """
    return read_manifest(path) if path.is_dir() else load_artifact(path).manifest


def identity_of(path: Path) -> str:
    """Identity of an artifact, 64 digits.

    Raises:
        ArtifactError: there is no artifact.
    """
    return manifest_of(path).identity


def print_identity(identity: str, console: Console) -> None:
    """The line that says what the figures above are of."""
    console.print(f"identity {abbreviated(identity)}", soft_wrap=True)
