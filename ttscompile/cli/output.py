"""Where results and progress of the commands go, and how tables are written."""

import json
import math
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

import click
from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from ttscompile.artifact.load import load_artifact, read_manifest, require_artifact_path
from ttscompile.artifact.manifest import Manifest, abbreviated
from ttscompile.errors import TtscompileError
from ttscompile.measure.machine import busy

_WIDTH = 110
"""Columns of a table that goes to a file or a pipe; a terminal's own width is used where there is one."""


class _Console(Console):
    """Does not end the process, as a check that failed, where nobody reads on."""

    def on_broken_pipe(self) -> None:
        """Called in the handler of the ``BrokenPipeError``."""
        raise


def results(width: int = _WIDTH) -> Console:
    """Console for results, on standard output; names and paths are shown as they are, whatever brackets they have."""
    console = _Console(highlight=False, markup=False, emoji=False)
    return console if console.is_terminal else _Console(highlight=False, markup=False, emoji=False, width=width)


def results_console() -> Console:
    """The same for scripts of ``examples``, whose tables are wider."""
    return results(150)


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Show a warning for users as one line, without a line of Python."""
    usual = warnings.formatwarning

    def told(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else usual(message, category, *where, **more)

    warnings.formatwarning = told
    try:
        yield
    finally:
        warnings.formatwarning = usual


def run(command: click.Command) -> None:
    """Run a script's command; an error of ttscompile is its message and exit status 2."""
    try:
        with plain_warnings():
            command()
    except TtscompileError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)


def progress() -> Console:
    """Console for progress and warnings, on standard error."""
    return _Console(stderr=True, highlight=False, markup=False, emoji=False)


def only_results_on_stdout() -> redirect_stdout[TextIO]:
    """Send to standard error what libraries print while they work."""
    return redirect_stdout(sys.stderr)


def print_json(document: Mapping[str, Any]) -> None:
    """Write one JSON document to standard output; NaN and infinity, which JSON has not, are null."""
    click.echo(json.dumps(_without_nan(document), indent=2, allow_nan=False))


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def say(console: Console, *lines: str) -> None:
    """Write lines without breaking them where the console ends."""
    for line in lines:
        console.print(line, soft_wrap=True)


def warn_if_busy(console: Console) -> None:
    """Say so where other programs keep the machine busy: what is timed then says little."""
    if (warning := busy()) is not None:
        say(console, f"warning: {warning}")


class _Table(Table):
    """Breaks no word or number where the console has room for all; rich squeezes the widest columns first."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        cells = [[str(cell) for cell in (one.header, *one.cells)] for one in self.columns]
        widths = [max(map(cell_len, each)) for each in cells]
        least = [max(cell_len(word) for cell in each for word in cell.split(" ")) for each in cells]
        side = int(sum(least) <= options.max_width - 3 * len(cells) - 1)  # of each cell, to both sides
        self.padding, room = (0, side), options.max_width - (1 + 2 * side) * len(cells) - 1
        while sum(least) <= room < sum(widths):  # names last
            widths[max(range(len(cells)), key=lambda n: (widths[n] > least[n], n > 0, widths[n]))] -= 1
        for n, (column, width) in enumerate(zip(self.columns, widths, strict=True)):
            column.width, column.no_wrap = (width, False) if sum(widths) <= room else (None, n == 0)
        return super().__rich_console__(console, options)


def table(*columns: str, rows: Iterable[Iterable[str]] = ()) -> Table:
    """A table whose first column is text and whose others are figures."""
    made = _Table(box=box.SIMPLE_HEAD)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left", no_wrap=i == 0, overflow="fold")
    for row in rows:
        made.add_row(*row)
    return made


def manifest_of(path: Path) -> Manifest:
    """Manifest of an artifact; in a directory nothing else is read and checked. Raises ArtifactError: there is none."""
    require_artifact_path(path)
    return read_manifest(path) if path.is_dir() else load_artifact(path).manifest


def print_identity(identity: str, console: Console) -> None:
    """The line that says what the figures above are of."""
    say(console, f"identity {abbreviated(identity)}")
