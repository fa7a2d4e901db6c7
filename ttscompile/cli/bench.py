"""``ttscompile bench``: what a call of the compiled policy takes, beside what it replaces."""

from __future__ import annotations

from pathlib import Path

import click

from ttscompile.cli.output import (
    artifact_argument,
    count_option,
    identity_of,
    json_option,
    ms,
    print_identity,
    print_json,
    progress,
    results,
    share,
    table,
)
from ttscompile.cli.timing import Measurement, contestants, measure
from ttscompile.measure.machine import fingerprint, one_line

RIVALS = ("original", "eager", "onnxruntime-dense")
"""The checkpoint with the sampler it was saved with; with the artifact's; and the artifact computed in full."""


def _rivals(_: click.Context, __: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in value.split(",") if name.strip()))
    unknown = [name for name in names if name not in RIVALS]
    if unknown:
        raise click.BadParameter(f"{unknown[0]!r} is not one of {', '.join(RIVALS)}.")
    return names


@click.command()
@artifact_argument
@count_option("--threads", "Threads that each contestant computes with.")
@count_option("--runs", "Calls of each contestant that are counted.", default=20)
@click.option("--plan", help="Plan of the compiled policy. Without this option its default plan runs.")
@click.option(
    "--against",
    default="onnxruntime-dense",
    show_default=True,
    callback=_rivals,
    help=f"What the compiled policy is timed against, any of {', '.join(RIVALS)}. The first two run the original"
    " network in PyTorch.",
)
@click.option(
    "--checkpoint",
    type=click.Path(path_type=Path),
    help="The checkpoint that DIRECTORY was made from. The rivals 'original' and 'eager' need it.",
)
@count_option("--seed", "Seed of the observations and the noise.", default=0, least=0)
@json_option
def bench(
    directory: Path,
    threads: int,
    runs: int,
    plan: str | None,
    against: tuple[str, ...],
    checkpoint: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Time calls of the artifact DIRECTORY and of its rivals, which take turns on the same random observations.

    Every figure is of whole calls, for one robot at a time. Warm-up calls are not counted.
    """
    if {"eager", "original"}.intersection(against) and checkpoint is None:
        raise click.UsageError("--against eager or original runs the original network: give --checkpoint FILE too.")
    console, identity = progress(), identity_of(directory)
    with console.status("loading"):
        entered = contestants(directory, threads, plan, against, checkpoint)
    if entered[0].plan == "dense":
        console.print(
            f"warning: {directory} runs dense: it is not calibrated, or --plan dense was given.",
            soft_wrap=True,
        )
    with console.status("timing") as status:
        measured = measure(entered, runs, seed, lambda done, total: status.update(f"timing: round {done} of {total}"))
    if as_json:
        print_json(
            {
                "identity": identity,
                "machine": fingerprint(),
                "threads": threads,
                "runs": runs,
                "contestants": [m.to_json() for m in measured],
            }
        )
        return
    made = table("", "ms a call", "quartiles", "calls/s", "speed-up", "GFLOP", "reused", "prologue", "pruner")
    for m in measured:
        made.add_row(*_row(m, measured[0]))
    output = results()
    output.print(made)
    output.print(
        f"Medians of {runs} calls, one stream, {threads} thread{'s' * (threads > 1)}; plan {entered[0].plan!r}."
        " Speed-up: how many times faster the first row is. Prologue and pruner: their ms of the call.",
        soft_wrap=True,
    )
    print_identity(identity, output)
    output.print(one_line(fingerprint()), soft_wrap=True)


def _row(m: Measurement, compiled: Measurement) -> tuple[str, ...]:
    low, high = m.quartiles_ms
    return (
        m.label,
        ms(m.median_ms, 4),
        f"{ms(low, 4)}..{ms(high, 4)}",
        f"{1000 / m.median_ms:.1f}",
        "" if m is compiled else f"{m.median_ms / compiled.median_ms:.1f} x",
        "" if m.flops is None else f"{m.flops / 1e9:.3f}",
        share(m.sparsity),
        "" if m.prologue_ms is None else f"{m.prologue_ms:.2f}",
        "" if m.pruner_ms is None else f"{m.pruner_ms:.2f}",
    )
