"""What deciding call by call could gain, before anybody builds what decides.

    python examples/ablation/oracle.py compiled/ --trajectories calls.npz --computed-steps 3

Schedules answer held-out calls. The best one for all calls is compared with what somebody could gain who chose a
schedule for each call: knowing everything, or what a pruner may know. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
from foresight import Oracle, oracle

from ttscompile.calibration.progress import Bar
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--computed-steps", default=3, help="Of a call.")
@click.option("--schedules", default=16, help="Of as many computed steps, and of one less and one more.")
@click.option("--calls", default=64, help="Observations to judge on, and as many to learn from, at most.")
@click.option("--draws", default=4, help="Of noise for each observation.")
@click.option("--seed", default=0, help="Of the division of the episodes, the calls, the noise and the schedules.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    computed_steps: int,
    schedules: int,
    calls: int,
    draws: int,
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    sizes = {"schedules": schedules, "calls": calls, "draws": draws, "seed": seed}
    with Bar(shown=True) as bar:
        found = oracle(directory, trajectories, computed_steps, observation=sources, **sizes, progress=bar.tell)
    if as_json:
        print_json(found.to_json())
    else:
        show(found)


def show(found: Oracle) -> None:
    """The choices as a table, and what they are."""
    output, made = results_console(), table("who chooses knows", "error", "gain", "95 % interval", "computed steps")
    for number, one in enumerate(found.choices):
        low, high = (f"{100 * bound:.0f}" for bound in one.interval)
        gain = ("", "") if number == 0 else (f"{100 * one.gain:.0f} %", f"{low} .. {high}")
        made.add_row(one.name, f"{one.error:.4g}", *gain, f"{one.steps:.2f}")
    output.print(made)
    observations, draws = found.calls
    offered = ", ".join(f"{number} of {count} computed steps" for count, number in found.schedules.items())
    say(
        output,
        f"Error: mean absolute difference of the executed actions, in their units, from those of the dense policy with"
        f" the same noise; {observations} observations with {draws} draws of noise each, of episodes that nothing was"
        f" learned from. Schedules: {offered}; each has a correction of its own. After the fact nobody can choose:"
        " these rows bound what can be gained. The other rows are a regression on what is known before the second step"
        " is computed.",
    )


if __name__ == "__main__":
    run(main)
