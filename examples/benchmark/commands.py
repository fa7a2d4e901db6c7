"""What the two programs of this folder share as commands."""

from __future__ import annotations

import sys

import click
from rich.console import Console

import ttscompile


def run(command: click.Command) -> None:
    """Run a program; an error of ttscompile is its message and exit status 2."""
    try:
        command()
    except ttscompile.TtscompileError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)


def results_console() -> Console:
    """Standard output; wide enough for the tables where it is no terminal."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=150)


def numbers(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, ...] | None:
    """``1,2,4`` of an option."""
    if value is None:
        return None
    parts = value.split(",")
    if not all(part.isdecimal() and int(part) for part in parts):
        raise click.BadParameter(f"{value!r}: expected positive whole numbers with commas between them.")
    return tuple(int(part) for part in parts)
