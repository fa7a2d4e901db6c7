"""What the commands share: where results and progress go, and how figures are written."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

artifact_argument = click.argument("directory", type=click.Path(path_type=Path))
json_option = click.option(
    "--json", "as_json", is_flag=True, help="One JSON document on standard output, nothing else."
)

_WIDTH = 110
"""Columns of a table that goes to a file or a pipe; a terminal's own width is used where there is one."""


def results() -> Console:
    """Console for results, on standard output."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=_WIDTH)


def progress() -> Console:
    """Console for progress and warnings, on standard error."""
    return Console(stderr=True, highlight=False)


@contextmanager
def only_results_on_stdout() -> Iterator[None]:
    """Send to standard error what libraries print while they work."""
    with redirect_stdout(sys.stderr):
        yield


def print_json(document: Mapping[str, Any]) -> None:
    """Write one JSON document to standard output; refuses NaN and infinity, which are not JSON."""
    click.echo(json.dumps(document, indent=2, allow_nan=False))


def table(*columns: str) -> Table:
    """A table whose first column is text and whose others are figures."""
    made = Table(box=box.SIMPLE_HEAD)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left", no_wrap=i == 0, overflow="fold")
    return made


def flops(count: float) -> str:
    """FLOPs with a unit: ``16.1 GFLOP``."""
    for unit, size in (("GFLOP", 1e9), ("MFLOP", 1e6), ("kFLOP", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}" if count < 1000 * size else f"{count / size:.0f} {unit}"
    return f"{count:.0f} FLOP"


def share(part: float | None) -> str:
    """A share in per cent, small ones to two digits more; empty if it is not known."""
    if part is None:
        return ""
    return f"{part:.1%}" if part == 0 or part >= 0.01 else f"{part:.3%}"
