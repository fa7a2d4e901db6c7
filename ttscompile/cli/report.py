"""``ttscompile report``: everything about an artifact on one page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.files import replace_file
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.output import artifact_argument, count_option, only_results_on_stdout, progress, results
from ttscompile.cli.recordings import FilesCommand, Sources, trajectories_options
from ttscompile.core.untrusted_json import parse_json
from ttscompile.errors import ArtifactError, OutputError, ReportError
from ttscompile.report import Given, Section, build, refused, render, verified
from ttscompile.report.comparison import from_comparison
from ttscompile.report.page import require_packages
from ttscompile.report.verified import NOT_RUN
from ttscompile.trajectories import Episode, load_trajectories

MAX_COMPARISON = 16 * 2**20
"""Bytes of what ``compare --json`` printed."""


@click.command(cls=FilesCommand)
@artifact_argument
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="The page to write; its name ends in .html."
)
@trajectories_options(required=False)
@click.option(
    "--episode",
    "number",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Number of the recorded episode that is run, from 0.",
)
@click.option(
    "--comparison",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A file with the output of 'ttscompile compare --json', whose points are drawn.",
)
@click.option(
    "--verify", "verifies", is_flag=True, help="Also run the checks of 'ttscompile verify', which take minutes."
)
@count_option("--threads", "Threads that the timed calls compute with.")
@count_option("--runs", "Calls of each plan that are counted.", default=10)
@click.pass_context
def report(
    context: click.Context,
    directory: Path,
    output: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    number: int,
    comparison: Path | None,
    verifies: bool,
    threads: int,
    runs: int,
) -> None:
    """Write a page about the artifact DIRECTORY: what it is, its plans, its times now, its errors, its limits.

    The page is one HTML file without scripts, which needs no other file. Times are measured while it is made. With
    recordings, one episode is run, to show what the default plan does from call to call. The exit status is 1 if a
    check of --verify failed; the page is written all the same.
    """
    if not output.absolute().parent.is_dir():
        raise OutputError(f"{output}: the report cannot be written: no such folder. Give one that exists.")
    if output.suffix not in (".html", ".htm"):
        raise OutputError(f"{output}: a report is a page of HTML. Give a name that ends in .html.")
    require_packages()  # before minutes of work
    console = progress()
    artifact = load_artifact(directory)
    manifest = artifact.manifest
    episode = None
    if trajectories:
        chunk = manifest.spec.chunk
        recorded = load_trajectories(trajectories, manifest.spec.observations, chunk.stop - chunk.start, sources)
        episode = _chosen(recorded, number)
    compared = None if comparison is None else from_comparison(_document(comparison))
    with only_results_on_stdout(), console.status("loading") as status:
        passed, section = True, NOT_RUN
        if verifies:
            passed, section = _verified(directory, trajectories, sources, threads, status.update)
        given = Given(episode, compared, section, threads, runs)
        policy = ttscompile.load(directory, threads=threads, seed=0)
        page = render(build(artifact, policy, given, status.update))
    try:
        replace_file(output, page.encode())
    except OSError as error:
        raise OutputError(f"{output}: the report cannot be written: {error}. Give a folder that exists.") from error
    results().print(
        f"wrote {output}, {len(page) / 1e6:.2f} MB, on artifact {manifest.short_identity}",
        soft_wrap=True,
    )
    if not passed:
        console.print("failed: the artifact does not hold what it promises; the page says where.", soft_wrap=True)
        context.exit(1)


def _verified(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    threads: int,
    progress: Callable[[str], None],
) -> tuple[bool, Section]:
    """Whether no check failed, and what the page says; an artifact that has nothing to check against fails none."""
    try:
        found = ttscompile.verify(
            directory,
            trajectories,
            sources=sources,
            threads=threads,
            progress=lambda what: progress(f"verifying: {what}"),
        )
    except ArtifactError as error:
        return True, refused(str(error))
    return found.passed, verified(found)


def _chosen(episodes: list[Episode], number: int) -> Episode:
    if number >= len(episodes):
        raise click.BadParameter(f"there are {len(episodes)} episodes, numbered from 0.", param_hint="--episode")
    return episodes[number]


def _document(path: Path) -> dict[str, Any]:
    """A JSON document of moderate size.

    Raises:
        ReportError: it is none.
    """
    try:
        document = parse_json(path.read_bytes(), MAX_COMPARISON)
    except (OSError, ValueError) as error:
        raise ReportError(
            f"{path}: no JSON document: {error}. Give what 'ttscompile compare ... --json' printed."
        ) from error
    if not isinstance(document, dict):
        raise ReportError(f"{path}: expected a JSON object; found another value. Give what compare --json printed.")
    return document
