"""``ttscompile calibrate``: an artifact learns its plan from a few trajectories."""

from __future__ import annotations

from pathlib import Path

import click

import ttscompile
from ttscompile.cli.output import artifact_argument, json_option, only_results_on_stdout, print_json, results
from ttscompile.cli.summary import document, print_summary

STRATEGIES = (
    "tts",
    "interval",
    "bac",
    "delta-dit",
    "deepcache",
    "sag",
    "dip-go",
    "l2c",
    "evo",
    "teacache",
    "dbcache",
)
"""``calibration.strategies.NAMES``; written again, since importing that takes torch and a second."""


class _FilesCommand(click.Command):
    """Lets ``--trajectories`` take every word up to the next option, which click's own options cannot."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        expanded: list[str] = []
        taking = False
        for arg in args:
            if taking and not arg.startswith("-"):
                expanded += ["--trajectories", arg]
                continue
            taking = arg == "--trajectories"
            if not taking:
                expanded.append(arg)
        return super().parse_args(ctx, expanded)


@click.command(cls=_FilesCommand)
@artifact_argument
@click.option(
    "--trajectories",
    required=True,
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE...",
    help="Recordings of episodes, .npz; every word up to the next option.",
)
@click.option(
    "--target-sparsity",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.95,
    show_default=True,
    help="Share of the cells to reuse.",
)
@click.option(
    "--strategy",
    type=click.Choice(STRATEGIES),
    default="tts",
    show_default=True,
    help="How the plan is found; tts is this project's own. The others are published methods: interval (FORA), bac,"
    " delta-dit, deepcache, sag, dip-go, l2c, evo, teacache, dbcache.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the split, the noise and the training.")
@click.option(
    "--max-minutes",
    type=click.FloatRange(min=0, min_open=True),
    default=15.0,
    show_default=True,
    help="Then the best plan so far is taken; also decides how many calls are used.",
)
@click.option("--resume", is_flag=True, help="Go on where a calibration that was interrupted stopped.")
@json_option
def calibrate(
    directory: Path,
    trajectories: tuple[Path, ...],
    target_sparsity: float,
    strategy: str,
    seed: int,
    max_minutes: float,
    resume: bool,
    as_json: bool,
) -> None:
    """Learn for the artifact DIRECTORY which residuals can be reused, from recorded episodes.

    The targets come from the dense policy itself with the same noise. Exit status 1: the target was not reached.
    """
    with only_results_on_stdout():
        ttscompile.calibrate(
            directory,
            trajectories=list(trajectories),
            target_sparsity=target_sparsity,
            strategy=strategy,
            seed=seed,
            resume=resume,
            max_minutes=max_minutes,
        )
    summary = document(directory)
    if as_json:
        print_json(summary)
    else:
        print_summary(summary, results())
