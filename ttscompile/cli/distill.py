"""``ttscompile distill``: weights of its own for a schedule that computes very few steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.cli.options import artifact_argument, count_option, json_option, seed_option
from ttscompile.cli.output import manifest_of, only_results_on_stdout
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.cli.summary import print_written
from ttscompile.cli.types import MINUTES, TEXT


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
@click.option("--plan", type=TEXT, default="schedule", show_default=True, help="Train weights for this schedule.")
@count_option("--rank", "Rank of the low-rank update to each weight matrix.", default=16)
@count_option("--updates", "Update the weights so many times, if there is time.", default=600)
@seed_option("Seed of the split, the noise and the training; take that of the calibration.")
@click.option("--max-minutes", type=MINUTES, default=15.0, show_default=True, help="End after so many minutes, about.")
@click.option(
    "--device", type=TEXT, help="Train on this device, as torch calls it: cuda, mps. Without this option it is the CPU."
)
@click.option("--resume", is_flag=True, help="Go on where a distillation that was interrupted stopped.")
@json_option
def distill(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    as_json: bool,
    **training: Any,  # ttscompile.distill takes them by the same names
) -> None:
    """Train weights for the later steps of a calibrated schedule of the artifact DIRECTORY. The last resort.

    Where very few steps are computed, no correction brings the actions back to those of the dense policy. The plan
    'distilled' then has weights of its own, trained to the dense policy's answers on the recorded observations. The
    original's weights stay beside them, for all other plans. Exit status 1: it is no better on held-out episodes.
    """
    manifest_of(directory)
    require_recordings(trajectories)
    with only_results_on_stdout():
        ttscompile.distill(directory, trajectories=list(trajectories), observation=sources, **training)
    print_written(directory, as_json)
