"""``ttscompile calibrate``: an artifact learns its plan from a few trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.calibration.proposer import NAMES as LEARNED
from ttscompile.calibration.proposer import PROPOSERS
from ttscompile.calibration.strategies import DEFAULT, NAMES, STRATEGIES
from ttscompile.cli.options import (
    artifact_argument,
    count_option,
    json_option,
    names_option,
    ray_option,
    seed_option,
    threads_option,
)
from ttscompile.cli.output import manifest_of, only_results_on_stdout
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.summary import print_written
from ttscompile.cli.types import ERROR, MILLISECONDS, MINUTES, SHARE, TEXT


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
@names_option(
    "--learn",
    LEARNED,
    default="schedule",
    help=f"What is learned, in this order: {'; '.join(f'{one.name}: {one.what}' for one in PROPOSERS)}.",
)
@click.option(
    "--target-sparsity",
    type=SHARE,
    help="Share of the cells to reuse; 0.95 if no budget is given, or what leaves five steps.",
)
@click.option(
    "--target-flops",
    type=SHARE,
    help="In its place: share of the FLOPs of a dense call to save, prologue and pruner counted.",
)
@click.option(
    "--latency-ms",
    type=MILLISECONDS,
    help="In its place: what a call with onnxruntime may take on this machine; measured at the start.",
)
@click.option(
    "--max-action-error",
    type=ERROR,
    help="In its place: the sparsest plan whose mean action error on held-out episodes, in the units of the actions, is"
    " not above this.",
)
@click.option(
    "--max-distance",
    type=ERROR,
    help="By how much further from the original a plan may be that costs less, in units of what other noise changes;"
    " without this option what each that learns allows.",
)
@threads_option("Of calls for --latency-ms.")
@click.option(
    "--strategy",
    type=click.Choice(NAMES),
    default=DEFAULT,
    show_default=True,
    help=f"How the schedule is found. {'; '.join(f'{one.name}: {one.source}' for one in STRATEGIES)}.",
)
@click.option(
    "--correct",
    is_flag=True,
    help="Fit a correction of the sampler to the schedule of a strategy that fits none: fair comparisons with tts.",
)
@count_option("--rank", "Of the low-rank update to each weight matrix, for weights.", default=16)
@count_option("--updates", "Of the weights.", default=600)
@seed_option("Of the split, the noise and the training.")
@click.option(
    "--max-minutes",
    type=MINUTES,
    default=15.0,
    show_default=True,
    help="All in all, about: the best plan found by then is taken. Also decides how many calls are used.",
)
@click.option(
    "--device",
    type=TEXT,
    help="Device that calls compute on, as torch calls it: cuda, mps. Without this option the CPU.",
)
@click.option("--resume", is_flag=True, help="Go on where a calibration that was interrupted stopped.")
@ray_option
@json_option
def calibrate(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    as_json: bool,
    **budget_and_search: Any,  # ttscompile.calibrate takes them by the same names
) -> None:
    """Learn plans for the artifact DIRECTORY from recorded episodes.

    What learns proposes plans; they are judged on episodes that nothing was learned from, by how far what they answer
    is from what the original answers. Beside the plan that keeps the budget the artifact gets 'safe', which computes
    twice as much, and 'fast', which computes half. Exit status 1: nothing was kept, or the budget was not.
    """
    manifest_of(directory)
    require_recordings(trajectories)
    with only_results_on_stdout():
        ttscompile.calibrate(directory, trajectories=list(trajectories), observation=sources, **budget_and_search)
    print_written(directory, as_json)
