"""``ttscompile verify``: is the artifact what it says, does it act as the original, and do its plans save anything?"""

from pathlib import Path

import click
from rich.console import Console

import ttscompile
from ttscompile.artifact.manifest import abbreviated
from ttscompile.cli.options import artifact_argument, json_option
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results, say, table
from ttscompile.cli.sections import Recordings, SectionedCommand, Sources, trajectories_options
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.report.build import figure


@click.command(cls=SectionedCommand)
@artifact_argument
@trajectories_options(required=False, what="Check what the plans do on these recorded episodes, too.")
@json_option
@click.pass_context
def verify(context: click.Context, directory: Path, trajectories: Recordings, sources: Sources, as_json: bool) -> None:
    """Check the artifact DIRECTORY against the answers of the original network that it holds.

    Neither the checkpoint nor PyTorch is needed. How far plans are from the original is told with --trajectories alone.
    The exit status is 1 if a check failed; the output says where, and what to do.
    """
    console = progress()
    with only_results_on_stdout(), console.status("verifying") as status:
        found = ttscompile.verify(
            directory, trajectories, sources=sources, progress=lambda what: status.update(f"verifying: {what}")
        )
    for rung in found.skipped:
        say(console, f"warning: {rung.name} was skipped: {rung.told.rstrip('.')}. {rung.remedy}")
    if as_json:
        print_json({"machine": fingerprint(), **found.to_json()})
    else:
        _print(found, results())
    if not found.passed:
        context.exit(1)


def _print(found: ttscompile.Verification, output: Console) -> None:
    rows = [(r.name, r.status, figure(r.figure), figure(r.tolerance), r.unit) for r in found.rungs]
    made = table("rung", "", "error", "allowed", "of what", rows=rows)
    made.columns[1].justify = made.columns[4].justify = "left"
    identity = "unknown" if found.identity is None else abbreviated(found.identity)
    say(output, f"{found.path}: identity {identity}")
    output.print(made)
    say(output, *(f"{rung.name}: {rung.told.rstrip('.')}." for rung in found.rungs))
    failure = found.first_failure
    if failure is None:
        told = f"All rungs hold{f', {len(found.skipped)} skipped' if found.skipped else ''}; {found.seconds:.1f} s."
    else:
        told = f"FAILED at {failure.name}{f' ({failure.place})' if failure.place else ''}. {failure.remedy}"
        if above := [rung.name for rung in found.failed[1:]]:
            told += f" What fails above it may only follow from it: {', '.join(above)}."
    say(output, told, one_line(fingerprint()))
