"""``ttscompile calibrate``: an artifact learns its plan from a few trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.calibration.strategies import DEFAULT, NAMES, STRATEGIES
from ttscompile.cli.options import artifact_argument, json_option, ray_option, seed_option, threads_option
from ttscompile.cli.output import manifest_of, only_results_on_stdout
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.summary import print_written
from ttscompile.cli.types import ERROR, MILLISECONDS, MINUTES, SHARE, TEXT


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
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
@threads_option("Of calls for --latency-ms.")
@click.option(
    "--strategy",
    type=click.Choice(NAMES),
    default=DEFAULT,
    show_default=True,
    help=f"How the plan is found. {'; '.join(f'{one.name}: {one.source}' for one in STRATEGIES)}.",
)
@click.option(
    "--correct",
    is_flag=True,
    help="Fit a correction of the sampler to the schedule of a strategy that fits none: fair comparisons with tts.",
)
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
    help="Device that the calls to learn from compute on, as torch calls it: cuda, mps. Without this option the CPU.",
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
    """Learn for the artifact DIRECTORY which residuals can be reused, from recorded episodes.

    The targets come from the dense policy itself with the same noise. Beside the plan that keeps the budget the
    artifact gets 'safe', which computes twice as much, and 'fast', which computes half. Exit status 1: the budget was
    not kept.
    """
    manifest_of(directory)
    require_recordings(trajectories)
    with only_results_on_stdout():
        ttscompile.calibrate(directory, trajectories=list(trajectories), observation=sources, **budget_and_search)
    print_written(directory, as_json)
