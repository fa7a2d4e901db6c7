"""``ttscompile report``: everything about an artifact on one page."""

from __future__ import annotations

from pathlib import Path

import click

import ttscompile
from ttscompile.artifact.files import replace_file
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.options import artifact_argument, count_option, runs_option, runtime_options, threads_option
from ttscompile.cli.output import only_results_on_stdout, progress, results, say
from ttscompile.cli.recordings import FilesCommand, Sources, trajectories_options
from ttscompile.cli.types import FILE, NEW_FILE
from ttscompile.errors import ArtifactChangedError, ArtifactError, OutputError
from ttscompile.report import Given, Section, build, render, verified
from ttscompile.report.comparison import read_comparison
from ttscompile.report.page import require_packages
from ttscompile.report.verified import NOT_RUN
from ttscompile.runtimes.load import open_policy
from ttscompile.trajectories import load_trajectories


@click.command(cls=FilesCommand)
@artifact_argument
@click.option("-o", "--output", type=NEW_FILE, required=True, help="The page to write; its name ends in .html.")
@trajectories_options(required=False)
@count_option("--episode", "Number of the recorded episode that is run, from 0.", default=0, least=0)
@click.option(
    "--comparison",
    type=FILE,
    help="A file with the output of 'ttscompile compare --json', whose points are drawn.",
)
@click.option(
    "--verify", "verifies", is_flag=True, help="Also run the checks of 'ttscompile verify', which take minutes."
)
@threads_option("Threads that the timed calls compute with.")
@runtime_options
@runs_option("Calls of each plan that are counted.", default=10)
@click.pass_context
def report(
    context: click.Context,
    directory: Path,
    output: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    episode: int,
    comparison: Path | None,
    verifies: bool,
    threads: int,
    runtime: str,
    device: str | None,
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
    chosen = None
    if trajectories:
        chunk = manifest.spec.chunk
        recorded = load_trajectories(trajectories, manifest.spec.observations, chunk.stop - chunk.start, sources)
        if episode >= len(recorded):
            raise click.BadParameter(f"there are {len(recorded)} episodes, numbered from 0.", param_hint="--episode")
        chosen = recorded[episode]
    compared = None if comparison is None else read_comparison(comparison)
    with only_results_on_stdout(), console.status("loading") as status:
        passed, section = True, NOT_RUN
        if verifies:
            try:
                found = ttscompile.verify(
                    directory,
                    trajectories,
                    sources=sources,
                    threads=threads,
                    progress=lambda what: status.update(f"verifying: {what}"),
                )
                if found.identity not in (None, manifest.identity):
                    raise ArtifactChangedError(f"{directory}: was replaced meanwhile. Report on it again.")
                passed, section = found.passed, verified(found)
            except ArtifactChangedError:
                raise
            except ArtifactError as error:  # it has nothing to check against, and so fails nothing
                section = Section("Verification", (f"Could not be run: {error}",))
        given = Given(chosen, compared, section, threads, runs)
        policy = open_policy(artifact, runtime, threads, seed=0, device=device)
        page = render(build(artifact, policy, given, status.update))
    try:
        replace_file(output, page.encode())
    except OSError as error:
        raise OutputError(f"{output}: the report cannot be written: {error}. Give a folder that exists.") from error
    say(results(), f"wrote {output}, {len(page) / 1e6:.2f} MB, on artifact {manifest.short_identity}")
    if not passed:
        say(console, "failed: the artifact does not hold what it promises; the page says where.")
        context.exit(1)
