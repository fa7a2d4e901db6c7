"""How many steps a call computes, decided on the way: is that better than a fixed number of as many on average?

    python examples/ablation/adaptive.py compiled/ --trajectories calls.npz --evaluations 3 --evaluations 4

Solvers of differential equations decide by an embedded estimate, and so does this: what the loop answers with a
computed step is compared with what its corrections make of the steps before alone. Where the two are close few steps
follow, or none; where they are far apart more do. Schedules, corrections and thresholds are learned on some episodes,
and judged on others, with the same noise. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
from deciding import Row
from nested import Decided, Nested, nested

from ttscompile.calibration.progress import Bar
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--evaluations", multiple=True, default=(3.0, 4.0), help="Of the network in a call, on average.")
@click.option("--most", default=6, help="Evaluations of any call.")
@click.option("--fitted", default=384, help="Calls that corrections are fitted on, at most.")
@click.option("--learned", default=384, help="Others, to choose schedules and thresholds on, at most.")
@click.option("--judged", default=400, help="Others again, to judge on, at most.")
@click.option("--minutes", default=10.0, help="Of searching.")
@click.option("--jumps", is_flag=True, help="Judge corrections that have jumps.")
@click.option("--seed", default=0, help="Of the division of the episodes, the calls and the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    evaluations: tuple[float, ...],
    most: int,
    fitted: int,
    learned: int,
    judged: int,
    minutes: float,
    jumps: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    sizes = {"most": most, "fitted": fitted, "learned": learned, "judged": judged, "seed": seed}
    with Bar(shown=True) as bar:
        found = nested(
            directory,
            trajectories,
            evaluations,
            observation=sources,
            minutes=minutes,
            jumps=jumps,
            **sizes,
            progress=bar.tell,
        )
    if as_json:
        print_json(found.to_json())
    else:
        show(found)


def show(found: Nested) -> None:
    """What was found as a table, and what the words in it mean."""
    output = results_console()
    made = table(
        "who decides", "evaluations", "at most", "error", "95 %", "99 %", "worst", "gain", "95 % interval", "rank"
    )
    for one in found.rows:
        made.add_row(*_cells(one))
    for each in found.decided:
        made.add_section()
        for one in each.rows:
            made.add_row(*_cells(one))
    output.print(made)
    for each in found.decided:
        say(output, _described(each))
    fitted, learned, judged = found.calls
    say(
        output,
        f"Error: mean absolute difference of the executed actions, in their units, from those of the dense policy with"
        f" the same noise; {judged} calls of {len(found.episodes['judged'])} episodes. Corrections were fitted on"
        f" {fitted} calls of others; {found.tried} schedules and the thresholds were compared on {learned} calls of"
        " others again. Gain: over fixed schedules of the same mean number of evaluations, a mixture of two where that"
        " is no whole number. Rank: correlation of the estimate with the error of the first ending. After the fact"
        " nobody can decide: this row bounds what can be gained.",
    )


def _cells(one: Row) -> list[str]:
    """A row of the table."""
    gain = ["", ""]
    if one.gain is not None:
        share, low, high = (f"{100 * each:.0f}" for each in one.gain)
        gain = [f"{share} %", f"{low} .. {high}"]
    tail = [f"{each:.3g}" for each in one.tail]
    rank = "" if one.rank is None else f"{one.rank:.2f}"
    return [one.name, f"{one.evaluations:.2f}", str(one.most), f"{one.error:.4g}", *tail, *gain, rank]


def _described(each: Decided) -> str:
    """The family in a sentence."""
    family = each.family
    shares = (*family.shares, 1.0)
    parts = [
        f"{', '.join(map(str, ending))} for {100 * (end - begin):.0f} %"
        for ending, begin, end in zip(family.endings, (0.0, *family.shares), shares, strict=True)
    ]
    back = ", and may go back" if family.returns else ""
    at = ", ".join(map(str, family.at))
    return f"{each.evaluations:g} evaluations: compares at {at}{back}; then computes {'; '.join(parts)}"


if __name__ == "__main__":
    run(main)
