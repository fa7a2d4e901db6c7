"""Calls whose caches are warm: of several calls in a row the last is timed, in turn with the dense plan's.

    python examples/benchmark/in_a_row.py compiled/ --in-a-row 3 --checkpoint policy.ckpt

``ttscompile bench`` times the first call after others, which have taken the processor's caches, as a robot's other work
does. The difference between the two is what the caches are worth.
"""

from __future__ import annotations

from pathlib import Path

import click

from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import Way, contestants, originals
from ttscompile.cli.options import artifact_argument, count_option, threads_option
from ttscompile.cli.output import results, run, say
from ttscompile.cli.summary import print_facts
from ttscompile.cli.types import PATH, TEXT
from ttscompile.report.timing import measure, timing_remarks, timing_table


@click.command()
@artifact_argument
@count_option("--in-a-row", "Have each make so many calls in its turn, and time the last one.", default=3, most=100)
@click.option("--plan", "plans", type=TEXT, multiple=True, help="Time this plan, beside the dense one.")
@click.option("--checkpoint", type=PATH, help="Time the checkpoint that DIRECTORY was made from, too.")
@threads_option("Threads that each computes with.")
@count_option("--calls", "Count so many calls of each.", default=20)
def main(
    directory: Path, in_a_row: int, plans: tuple[str, ...], checkpoint: Path | None, threads: int, calls: int
) -> None:
    """Time calls in a row of plans of the artifact DIRECTORY."""
    artifact = load_artifact(directory)
    entered = contestants({"": artifact}, plans, [Way(threads=threads)])
    if checkpoint is not None:
        entered = [*originals(checkpoint, None, threads, artifact), *entered]
    measured = measure(entered, calls, 0, in_a_row=in_a_row)
    output = results()
    print_facts(output, timing_table(measured, artifact.manifest.default_plan, ("prologue", "pruner")))
    say(output, timing_remarks(measured), f"The last of {in_a_row} calls in a row: its caches are warm.")


if __name__ == "__main__":
    run(main)
