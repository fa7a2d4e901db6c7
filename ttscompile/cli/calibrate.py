"""``ttscompile calibrate``: an artifact learns its plan from a few trajectories."""

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.proposers import PROPOSERS, RIVALS
from ttscompile.cli import options
from ttscompile.cli.ending import Status
from ttscompile.cli.output import manifest_of, only_results_on_stdout
from ttscompile.cli.sections import Recordings, SectionedCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.summary import print_artifact
from ttscompile.cli.types import ERROR, MILLISECONDS, MINUTES, SHARE, TEXT
from ttscompile.core.plan import SCHEDULE

_LEARNED = "; ".join(f"{one.name}: {one.what}" for one in PROPOSERS if one not in RIVALS)
_RIVALS = ", ".join(one.name for one in RIVALS)


@click.command(cls=SectionedCommand)
@options.artifact_argument
@trajectories_options()
@options.names_option(
    "--learn",
    [one.name for one in PROPOSERS],
    default=SCHEDULE,
    help=f"Learn these, in this order: {_LEARNED}. In place of schedule, a rival to compare it with: {_RIVALS}.",
)
@options.number_option(
    "--target-sparsity",
    SHARE,
    "Reuse this share of the cells. Without any budget it is 0.95, or what leaves five steps to compute.",
)
@options.number_option(
    "--target-flops",
    SHARE,
    "Save this share of the FLOPs of a dense call, prologue and pruner counted, in place of --target-sparsity.",
)
@options.number_option(
    "--latency-ms",
    MILLISECONDS,
    "Have a call take no longer than this with onnxruntime on this machine, measured at the start, in place of"
    " --target-sparsity.",
)
@options.number_option(
    "--max-action-error",
    ERROR,
    "Take the sparsest plan whose mean action error on held-out episodes, in the units of the actions, is not"
    " above this, in place of --target-sparsity.",
)
@options.number_option(
    "--max-distance",
    ERROR,
    "Take a cheaper plan if it is no further than this from the original than a dearer one, in units of what other"
    " noise changes; without this option it is what each that learns allows. With --learn loops: distance from the"
    " original that the default plan may have.",
)
@options.threads_option("Time the calls of --latency-ms with so many threads.")
@options.seed_option("Draw the split, the noise and the training with this seed.")
@options.number_option(
    "--max-minutes",
    MINUTES,
    "Take the best plan that is found in so many minutes of work, about: where the machine does other things, too, it"
    " takes up to twice as long. Also decides how many calls are used.",
    default=15.0,
)
@click.option(
    "--device",
    type=TEXT,
    help="Compute calls on this device, as torch calls it: cuda, mps. Without this option it is the CPU.",
)
@click.option("--resume", is_flag=True, help="Go on where a calibration that was interrupted stopped.")
@options.ray_option
@options.json_option
def calibrate(
    directory: Path,
    trajectories: Recordings,
    sources: Sources,
    as_json: bool,
    **budget_and_search: Any,  # ttscompile.calibrate takes them by the same names
) -> None:
    """Learn plans for the artifact DIRECTORY from recorded episodes.

    What learns proposes plans; they are judged on episodes that nothing was learned from, by how far what they answer
    is from what the original answers. Beside the plan that keeps the budget the artifact gets 'safe', which computes
    twice as much, and 'fast', which computes half. Exit status 1: nothing was kept, the budget was
    not, or the default plan's distance from the original is above a quarter of what other noise changes.
    """
    manifest_of(directory)
    require_recordings(trajectories)
    with only_results_on_stdout():
        result = ttscompile.calibrate(
            directory, trajectories=list(trajectories), observation=sources, **budget_and_search
        )
    print_artifact(load_artifact(directory), as_json, whole=False)
    if result.doubtful:
        raise click.exceptions.Exit(Status.FAILED)
