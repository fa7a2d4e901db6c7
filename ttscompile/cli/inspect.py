"""``ttscompile inspect``: what is in an artifact, as tables, as a picture of a plan, or all of it on a page."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

import ttscompile
from ttscompile.artifact.files import replace_file
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.calibration.progress import Bar
from ttscompile.cli.options import artifact_argument, json_option
from ttscompile.cli.output import only_results_on_stdout, progress, say
from ttscompile.cli.sections import Recordings, Section, SectionedCommand, Sources, trajectories_options
from ttscompile.cli.summary import print_artifact
from ttscompile.cli.types import PAGE_OR_PICTURE, PAGES, TEXT
from ttscompile.core.lattice import PlanArray
from ttscompile.core.plan import FULL, SCHEDULE
from ttscompile.errors import ArtifactChangedError, ArtifactError, OutputError, needing
from ttscompile.measure.points import JudgedPlan
from ttscompile.plots.figure import write_picture
from ttscompile.plots.maps import plot_plan
from ttscompile.report import Extras, Section as OfPage, build, render, verified
from ttscompile.report.build import NOT_RUN
from ttscompile.report.page import require_packages
from ttscompile.report.usage import run_episode
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.trajectories import Episode, episodes_of

SECTIONS = (
    Section("What a page or a picture shows of an episode", ("trajectories", "sources"), ("output",)),
    Section("What a picture shows", ("name",), ("output",)),
    Section("What a page shows", ("verifies",), ("output",)),
)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@artifact_argument
@click.option(
    "-o",
    "--output",
    type=PAGE_OR_PICTURE,
    help="Write all about it into this page (.html), which needs no other file: its plans, its times on this machine,"
    " its errors, its limits. Or draw a plan into this picture (.png, .svg or .pdf).",
)
@trajectories_options(
    required=False,
    what="Run the first of these recorded episodes, and show what its calls execute. A page also shows the calls in"
    " which the plan is furthest from the original.",
)
@click.option(
    "--plan", "name", type=TEXT, help="Draw this plan. Without this option it is the default plan of the artifact."
)
@click.option("--verify", "verifies", is_flag=True, help="Run the checks of 'ttscompile verify', which take minutes.")
@json_option
@click.pass_context
def inspect(
    context: click.Context,
    directory: Path,
    output: Path | None,
    trajectories: Recordings,
    sources: Sources,
    name: str | None,
    verifies: bool,
    as_json: bool,
) -> None:
    """Show what the artifact DIRECTORY holds: the policy, its blocks, what they cost, its plans and calibration.

    With -o FILE.html it also times calls of every plan, and writes a page. The exit status is 1 if a check of --verify
    failed; the page is written all the same.
    """
    page, picture = (output, None) if output is not None and output.suffix.lower() in PAGES else (None, output)
    if page is not None and name is not None:
        raise click.UsageError(f"--plan is for a picture (.png); found --output {page}.")
    if picture is not None and verifies:
        raise click.UsageError(f"--verify is for a page (.html); found --output {picture}.")
    if page is not None:
        require_page(page)
    console, artifact = progress(), load_artifact(directory)
    manifest, episodes = artifact.manifest, list[Episode]()
    if trajectories:
        episodes = episodes_of(manifest.spec, trajectories, sources, artifact.tokenizer)
    episode = episodes[0] if episodes else None
    passed, section = True, NOT_RUN
    if page is not None:
        judged = judged_plan(artifact, episodes)
        with only_results_on_stdout(), console.status("loading") as status:
            if verifies:
                passed, section = checked(directory, manifest.identity, trajectories, sources, status.update)
            policy = open_policy(artifact, seed=0)
            told = write_page(page, artifact, policy, Extras(episode, section, judged), status.update)
        say(console, told)
    if picture is not None:
        name, kinds = name or manifest.default_plan, [block.kind for block in manifest.blocks]
        write_picture(plot_plan(_plan(artifact, name, episode), kinds, f"plan {name!r}"), picture)
        say(console, f"wrote {picture}")
    print_artifact(replace(artifact, path=directory), as_json)  # of a zipped one, not where it was unpacked
    if not passed:
        say(console, "failed: the artifact does not hold what it promises; the page says where.")
        context.exit(1)


def judged_plan(artifact: Artifact, episodes: Sequence[Episode]) -> JudgedPlan | None:
    """The default plan, or what a build kept beside the original, on calls that its calibration held out.

    None where there is no such plan, or nothing can be held out.
    """
    manifest = artifact.manifest
    name = next((n for n in (manifest.default_plan, SCHEDULE) if n in manifest.plans and n != FULL), None)
    if name is None or len(episodes) < 2:
        return None
    with needing("-t", "compile"):
        from ttscompile.calibration.compare import judge_plan
    with only_results_on_stdout(), Bar(shown=True) as bar:
        return judge_plan(artifact, episodes, name, bar, int((manifest.calibration or {}).get("seed", 0)))


def _plan(artifact: Artifact, name: str, episode: Episode | None) -> PlanArray:
    """The plan to draw, int8 ``[K, blocks]``: of one that is made for each observation, what the last call executed."""
    if (cells := artifact.plan(name).cells) is not None:
        return cells
    if episode is None:
        others = ", ".join(each for each, one in artifact.plans.items() if not one.pruned)
        raise ArtifactError(
            f"{artifact.path}: plan {name!r} is made for each observation, and none was given. Add --trajectories"
            f" FILE, or draw a schedule with --plan: {others}."
        )
    # Of this artifact, whatever is there by now.
    return np.asarray(run_episode(open_policy(artifact, seed=0), episode, name).plans[-1])


def require_page(path: Path) -> None:
    """Raise OutputError or RuntimeUnavailableError, before minutes of work, unless a page can be made there."""
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: the page cannot be written: no such folder. Give one that exists.")
    require_packages()


def write_page(
    path: Path, artifact: Artifact, policy: CompiledPolicy, extras: Extras, progress: Callable[[str], None]
) -> str:
    """Write the page, which replaces another one only when it is whole, and say so; calls of the policy are timed."""
    page = render(build(artifact, policy, extras, progress))
    try:
        replace_file(path, page.encode())
    except OSError as error:
        raise OutputError(f"{path}: the page cannot be written: {error}. Give a folder that exists.") from error
    return f"wrote {path}, {len(page) / 1e6:.2f} MB"


def checked(
    directory: Path, identity: str, trajectories: Recordings, sources: Sources, progress: Callable[[str], None]
) -> tuple[bool, OfPage]:
    """Whether the checks of ``ttscompile verify`` hold for the artifact of this identity, and what the page says."""
    try:
        found = ttscompile.verify(
            directory, trajectories, sources=sources, progress=lambda it: progress(f"verifying: {it}")
        )
    except ArtifactChangedError:
        raise
    except ArtifactError as error:  # it has nothing to check against, and so fails nothing
        return True, OfPage("Verification", (f"Could not be run: {error}",))
    if found.identity not in (None, identity):
        raise ArtifactChangedError(f"{directory}: was replaced meanwhile. Inspect it again.")
    return found.passed, verified(found)
