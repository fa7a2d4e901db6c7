"""``ttscompile doctor``: what stands in the way of a machine, an artifact, a checkpoint and recordings."""

from pathlib import Path
from typing import Any

import click

from ttscompile.cli.options import json_option
from ttscompile.cli.output import manifest_of, only_results_on_stdout, print_json
from ttscompile.cli.sections import Recordings, SectionedCommand, require_recordings, trajectories_options
from ttscompile.cli.types import PathOrHub
from ttscompile.doctor import diagnosis as examination


@click.command(cls=SectionedCommand)
@click.argument("target", required=False, type=PathOrHub(exists=True))
@trajectories_options(required=False, what="See whether these recorded episodes fit TARGET.")
@json_option
@click.pass_context
def doctor(
    context: click.Context, /, target: Path | str | None, trajectories: Recordings, as_json: bool, **how: Any
) -> None:
    """Look at Python, packages, processor, cores, memory and clock; with TARGET, also at that.

    TARGET is an artifact, which is tried here; or a checkpoint as 'ttscompile convert' takes it, which is searched for
    what goes wrong on robots without an error: cameras, normalisers, tokenizer, chunk.

    Every warning and problem comes with its remedy. The exit status is 1 if there is a problem. Where the command line
    itself does not start, python -m ttscompile.doctor says why.
    """
    if trajectories and target is None:
        raise click.UsageError("--trajectories is for TARGET: give a checkpoint or an artifact too.")
    require_recordings(trajectories)
    with only_results_on_stdout():
        found = examination.examine(target, recordings=trajectories, **how)
    if as_json:
        opened = any(finding.what == "identity" for finding in found)
        of = {"identity": manifest_of(target).identity} if isinstance(target, Path) and opened else {}
        print_json(of | examination.document(found))
    else:
        click.echo(examination.text(found))
    if examination.problems(found):
        context.exit(1)
