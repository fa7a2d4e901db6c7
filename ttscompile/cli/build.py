"""``ttscompile build``: from a checkpoint to the fastest policy that is safe."""

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import require_replaceable
from ttscompile.cli.options import json_option, lerobot_options, number_option, policy_hz_option, threads_option
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results, say, warn_if_busy
from ttscompile.cli.sections import (
    LEROBOT,
    Recordings,
    Section,
    SectionedCommand,
    Sources,
    require_recordings,
    trajectories_options,
)
from ttscompile.cli.summary import print_frontier
from ttscompile.cli.types import ERROR, MILLISECONDS, MINUTES, PATH, PATH_OR_HUB, RATE
from ttscompile.core.paths import on_hub, require_path
from ttscompile.errors import CheckpointError
from ttscompile.frontends.families import GIVE
from ttscompile.report.summary import document

SECTIONS = (Section("In a control loop", ("control_hz", "policy_hz")), LEROBOT)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@click.argument("checkpoint", type=PATH_OR_HUB)
@trajectories_options(
    required=False,
    what="Learn from these recorded episodes; without any, from those of its training, if CHECKPOINT says which.",
)
@click.option("-o", "--output", "directory", required=True, type=PATH, help="Write the artifact into this folder.")
@number_option(
    "--control-hz",
    RATE,
    "Choose, of the plans that keep up with a control loop of this rate in Hz, the one that is nearest to the original."
    " Without a deadline the fastest is chosen.",
)
@policy_hz_option
@number_option(
    "--latency-ms",
    MILLISECONDS,
    "Choose among the plans of whose calls 99 of 100 take at most so many milliseconds, in place of --control-hz.",
)
@number_option(
    "--error",
    ERROR,
    "Take no plan that is further from the original, in units of what other noise changes; with 95 % confidence at"
    " most a quarter further. Without this option it is 0.1 for the default plan, and 0.25 for others. If"
    " no plan is surely within 0.1, the original stays the default.",
)
@threads_option("Time calls with so many threads: those that the policy will have on the robot.")
@number_option("--minutes", MINUTES, "Be done in so many minutes, about, once it is compiled.", default=30.0)
@click.option("--resume", is_flag=True, help="Go on where the same build was interrupted, or ended with the original.")
@lerobot_options
@json_option
def build(
    checkpoint: Path | str,
    directory: Path,
    trajectories: Recordings,
    sources: Sources,
    error: float | None,
    minutes: float,
    as_json: bool,
    **how: Any,  # ttscompile.build takes them by the same names
) -> None:
    """Compile CHECKPOINT, and choose the fastest plan that is near enough to the original.

    If others take at most a fifth longer and are nearer by more than a fifth, one of them is chosen.

    Denoising loops, computed steps, corrections, eight bits and image tokens are tried; all are judged on recorded
    episodes that nothing was learned from, and timed on this machine. Exit status 1: no plan is near enough, or none of
    those keeps the deadline.
    """
    if not on_hub(checkpoint):
        require_path(checkpoint, CheckpointError, GIVE)
    require_replaceable(directory)
    require_recordings(trajectories)
    console = progress()
    warn_if_busy(console)
    with only_results_on_stdout(), console.status("compiling") as status:

        def explain(stage: str, notes: tuple[str, ...]) -> None:
            status.update(f"compiling: after {stage}")
            if stage in ("recordings", "loop", "resume", "end"):
                say(console, *notes)
            if stage == "write":
                status.stop()  # the search has a bar of its own

        ttscompile.build(
            checkpoint,
            directory,
            trajectories,
            observation=sources,
            max_distance=error,
            max_minutes=minutes,
            explain=explain,
            **how,
        )
    artifact = load_artifact(directory)
    if as_json:
        print_json(document(artifact))
    else:
        print_frontier(artifact, directory, results(150), how["threads"], how["control_hz"])
