"""``ttscompile verify``: is the artifact what it says, does it act as the original, and do its plans save anything?"""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

import ttscompile
from ttscompile.artifact.manifest import abbreviated
from ttscompile.cli.output import artifact_argument, json_option, only_results_on_stdout, print_json, progress, results
from ttscompile.cli.output import table as make_table
from ttscompile.cli.recordings import FilesCommand, Sources, trajectories_options
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.plots.errors import plot_errors


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options(required=False)
@click.option("--calls", type=click.IntRange(min=1), default=24, show_default=True, help="Recorded calls, at least.")
@click.option("--threads", type=click.IntRange(min=1), default=1, show_default=True, help="Of onnxruntime.")
@click.option(
    "--plot",
    "picture",
    type=click.Path(path_type=Path),
    help="Draw the errors of residuals, steps across and blocks down, into this file (.png, .svg, .pdf).",
)
@json_option
@click.pass_context
def verify(
    context: click.Context,
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    calls: int,
    threads: int,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Check the artifact DIRECTORY against the answers of the original network that it holds.

    Neither the checkpoint nor torch is needed. Without --trajectories the error of reuse is told, and not judged. Exit
    status 1: a check failed; the first that did says where and what to do.
    """
    console = progress()
    with only_results_on_stdout(), console.status("verifying") as status:
        found = ttscompile.verify(
            directory,
            trajectories,
            sources=sources,
            calls=calls,
            threads=threads,
            progress=lambda what: status.update(f"verifying: {what}"),
        )
    for rung in found.skipped:
        console.print(f"warning: {rung.name} was skipped: {rung.told.rstrip('.')}. {rung.remedy}", soft_wrap=True)
    if as_json:
        print_json({"machine": fingerprint(), "threads": threads, **found.to_json()})
    else:
        _print(found, results())
    if picture is not None:
        console.print(_draw(found, picture), soft_wrap=True)
    if not found.passed:
        context.exit(1)


def _draw(found: ttscompile.Verification, picture: Path) -> str:
    """Draw, and say so."""
    errors = found.map
    if errors is None:
        return f"warning: {picture}: there is nothing to draw: the residuals were not looked at."
    title = f"{Path(found.path).resolve().name}, identity {abbreviated(found.identity or '')}"
    plot_errors(
        errors.errors, errors.steps.tolist(), errors.kinds, errors.tolerance, picture, title, errors.cells, errors.plan
    )
    return f"wrote {picture}"


def _print(found: ttscompile.Verification, output: Console) -> None:
    """The ladder as a table, and what to do."""
    made = make_table("rung", "", "error", "allowed", "of what")
    made.columns[1].justify = made.columns[4].justify = "left"
    for rung in found.rungs:
        made.add_row(rung.name, rung.status, _number(rung.figure), _number(rung.tolerance), rung.unit)
    identity = "unknown" if found.identity is None else abbreviated(found.identity)
    output.print(f"{found.path}: identity {identity}", soft_wrap=True)
    output.print(made)
    for rung in found.rungs:
        output.print(f"{rung.name}: {rung.told.rstrip('.')}.", soft_wrap=True)
    failure = found.first_failure
    if failure is None:
        told = f"All rungs hold{f', {len(found.skipped)} skipped' if found.skipped else ''}; {found.seconds:.1f} s."
    else:
        told = f"FAILED at {failure.name}{f' ({failure.place})' if failure.place else ''}. {failure.remedy}"
        if above := [rung.name for rung in found.failed[1:]]:
            told += f" What fails above it may only follow from it: {', '.join(above)}."
    output.print(told, soft_wrap=True)
    output.print(one_line(fingerprint()), soft_wrap=True)


def _number(figure: float | None) -> str:
    return "" if figure is None else f"{figure:.2g}"
