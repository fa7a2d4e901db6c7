"""``ttscompile doctor``: what of this machine and installation stands in the way of running artifacts."""

from __future__ import annotations

from pathlib import Path

import click

from ttscompile.cli.options import json_option
from ttscompile.cli.output import identity_of, print_json
from ttscompile.cli.types import PathName
from ttscompile.doctor import diagnosis as examination


@click.command()
@click.argument("directory", required=False, type=PathName(exists=True))
@json_option
@click.pass_context
def doctor(context: click.Context, directory: Path | None, as_json: bool) -> None:
    """Look at Python, packages, processor, cores, memory and clock; with DIRECTORY, also try that artifact here.

    Every warning and problem comes with its remedy. The exit status is 1 if something stops artifacts from running.
    Where the command line itself does not start, python -m ttscompile.doctor says why.
    """
    found = examination.examine(directory)
    if as_json:
        opened = any(finding.what == "identity" for finding in found)
        of = {"identity": identity_of(directory)} if directory is not None and opened else {}
        print_json(of | examination.document(found))
    else:
        click.echo(examination.text(found))
    if examination.problems(found):
        context.exit(1)
