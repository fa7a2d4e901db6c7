"""``ttscompile warm-start``: begin calls with the chunk of the call before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.settle import settle
from ttscompile.cli.options import artifact_argument, count_option, json_option, seed_option
from ttscompile.cli.output import (
    counted_parts,
    manifest_of,
    only_results_on_stdout,
    print_json,
    results,
    say,
    table,
)
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.types import ERROR
from ttscompile.report.facts import told_warm


@click.command("warm-start", cls=FilesCommand)
@artifact_argument
@trajectories_options(required=False, what="Measure on these recorded episodes.")
@count_option("--calls", "Measure so many calls, at most.", default=512, least=2)
@click.option(
    "--max-distance",
    type=ERROR,
    default=1.4,
    show_default=True,
    help="Allow actions to be so far from those of a dense call with other noise; 1 is how far two dense calls are"
    " apart.",
)
@seed_option("Seed of the noise.")
@click.option("--off", is_flag=True, help="Forget what was settled.")
@json_option
def warm_start(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    off: bool,
    as_json: bool,
    **settings: Any,  # ttscompile.warm_start takes them by the same names
) -> None:
    """Settle from which step on calls of the artifact DIRECTORY may go on with the chunk of the call before.

    A program that loads it with warm=True then computes the whole loop in the first call of an episode, and these last
    steps in all others. This takes the fewest steps whose actions are close to those of a dense call: after the call
    before, and after a call of another episode, as if the world had changed. Exit status 1: no number of steps up to
    half of the loop is close enough, and nothing was changed.
    """
    manifest_of(directory)
    if off == bool(trajectories):
        raise click.UsageError("give --trajectories FILE..., or --off.")
    if off:
        settle(directory, "warm", None)
        if as_json:
            print_json({"warm": None, "tried": []})
        else:
            say(results(), "calls begin with noise")
        return
    require_recordings(trajectories)
    with only_results_on_stdout(), counted_parts() as tell:
        found = ttscompile.warm_start(directory, list(trajectories), observation=sources, progress=tell, **settings)
    if as_json:
        print_json({"warm": vars(found.warm), "tried": [vars(one) for one in found.tried]})
        return
    head = ("last steps", "distance from a dense call", "where the world has changed")
    rows = [(str(one.last_steps), f"{one.same:.3g}", f"{one.changed:.3g}") for one in found.tried]
    results().print(table(*head, rows=rows))
    say(results(), "A distance of 1 is that of two dense calls with different noise.")
    say(results(), told_warm(found.warm, manifest_of(directory).steps))
