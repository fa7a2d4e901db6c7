"""``ttscompile oracle``: what deciding call by call could gain."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ttscompile.cli.options import artifact_argument, count_option, json_option, seed_option
from ttscompile.cli.output import counted_parts, manifest_of, only_results_on_stdout, print_json, results, say, table
from ttscompile.cli.recordings import FilesCommand, Sources, require_recordings, trajectories_options
from ttscompile.errors import RuntimeUnavailableError

if TYPE_CHECKING:
    from ttscompile.rivals.oracle import Oracle


@click.command(cls=FilesCommand)
@artifact_argument
@trajectories_options()
@count_option("--computed-steps", "Of a call.", default=3, least=2)
@count_option("--schedules", "Of as many computed steps, and of one less and one more.", default=16, least=2)
@count_option("--calls", "Observations to judge on, and as many to learn from, at most.", default=64, least=2)
@count_option("--draws", "Of noise for each observation.", default=4, least=2)
@seed_option("Of the division of the episodes, the calls, the noise and the schedules.")
@json_option
def oracle(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    computed_steps: int,
    as_json: bool,
    **sizes: Any,  # ttscompile.rivals.oracle takes them by the same names
) -> None:
    """Would it pay to decide for each call which steps are computed? For the policy of the artifact DIRECTORY.

    Schedules answer held-out calls. The best one for all calls is compared with what somebody could gain who chose a
    schedule for each call: knowing everything, or what a pruner may know. Nothing is written.
    """
    manifest_of(directory)
    require_recordings(trajectories)
    try:
        from ttscompile.rivals.oracle import oracle as measure
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"oracle needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]'."
        ) from error
    with only_results_on_stdout(), counted_parts() as tell:
        found = measure(directory, trajectories, computed_steps, observation=sources, progress=tell, **sizes)
    if as_json:
        print_json(found.to_json())
    else:
        _print(found)


def _print(found: Oracle) -> None:
    """The choices as a table, and what they are."""
    output = results()
    made = table("who chooses knows", "error", "gain", "95 % interval", "computed steps")
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
        f" learned from. Schedules: {offered}; each has a correction of its own.",
        "Gain: share of the first row's error that is saved. After the fact nobody can choose: these rows bound what"
        " can be gained. The other rows are a regression on what is known before the second step is computed.",
    )
