"""What do several evaluations at once cost on a core, as methods need them that draft steps and check them together?

    python examples/benchmark/at_once.py DIR [DIR:PLAN...] --rows 2,4,8,16

TS-DP (arXiv 2512.15773) has a small network draft the steps of a loop, and the policy checks many of them in one
evaluation; Falcon looks at all samples that a call could begin with. On a GPU that takes about as long as one step.
Here the loop is timed with one row and with several. Each row is a step to check, so what is printed is the least share
of the whole loop that such a call takes: with drafts that are all right, and a drafter that takes no time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import click
import numpy as np
from rich.table import Table

from ttscompile.artifact.load import load_artifact
from ttscompile.cli.options import count_option, json_option, threads_option
from ttscompile.cli.output import print_json, results, results_console, run, say
from ttscompile.core.plan import DENSE
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import Observation, random_calls


@dataclass(frozen=True)
class Row:
    """One policy.

    Attributes:
        ms: of the loop with one row.
        shares: by number of rows, the loop's time over so many times that of one row.
    """

    label: str
    ms: float
    shares: dict[int, float]


def loop_ms(policy: CompiledPolicy, observations: Sequence[Observation], rows: int) -> float:
    """Milliseconds of the loop in the last of some calls of so many streams."""
    policy.reset(seed=0)
    for obs in observations:
        policy.predict_action({key: np.repeat(value, rows, axis=0) for key, value in obs.items()})
    assert policy.last_report is not None
    return policy.last_report.timings.decode


def measured(label: str, rows: Sequence[int], rounds: int, threads: int) -> Row:
    """All numbers of rows in turn, after one round that does not count."""
    directory, _, plan = label.partition(":")
    artifact = load_artifact(Path(directory))
    policy = open_policy(artifact, plan=plan or DENSE, threads=threads)
    observations = [obs for obs, _ in random_calls(artifact.manifest.spec, 2, 0)]
    times: dict[int, list[float]] = {count: [] for count in (1, *rows)}
    for _ in range(1 + rounds):
        for count, kept in times.items():
            kept.append(loop_ms(policy, observations, count))
    ms = {count: median(kept[1:]) for count, kept in times.items()}
    return Row(label, ms[1], {count: ms[count] / (count * ms[1]) for count in rows})


def _rows(_: click.Context, __: click.Parameter, value: str) -> tuple[int, ...]:
    try:
        found = tuple(dict.fromkeys(int(word) for word in value.split(",")))
    except ValueError as error:
        raise click.BadParameter(f"{error}; expected numbers, such as 2,4,8.") from error
    if min(found) < 2:
        raise click.BadParameter(f"{min(found)} is below 2.")
    return found


@click.command()
@click.argument("policies", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@click.option("--rows", default="2,4,8,16", show_default=True, callback=_rows, help="Evaluate so many at once.")
@count_option("--rounds", "Time each so often.", default=10)
@threads_option("Threads that each computes with.")
@json_option
def main(policies: tuple[str, ...], rows: tuple[int, ...], rounds: int, threads: int, as_json: bool) -> None:
    """Time the loops of DIR, with the plan that computes every cell if none is named."""
    found = [measured(label, rows, rounds, threads) for label in policies]
    if as_json:
        print_json({"machine": fingerprint(), "policies": [asdict(row) for row in found]})
        return
    table = Table(title="steps evaluated together: the loop's time, as a share of one step after the other")
    for column in ("policy", "ms, one row", *(f"{count} rows" for count in rows)):
        table.add_column(column, justify="right" if column != "policy" else "left")
    for row in found:
        table.add_row(row.label, f"{row.ms:.1f}", *(f"{share:.2f}" for share in row.shares.values()))
    results_console().print(table)
    say(results(), one_line(fingerprint()))


if __name__ == "__main__":
    run(main)
