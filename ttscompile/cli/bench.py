"""``ttscompile bench``: what a call of the compiled policy takes, beside what it replaces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli.options import (
    artifact_argument,
    count_option,
    json_option,
    names_option,
    runs_option,
    runtime_options,
    seed_option,
    several_threads_option,
)
from ttscompile.cli.output import print_identity, print_json, progress, results, say, table
from ttscompile.cli.timing import Compiled, Measurement, contestants, measure
from ttscompile.cli.types import FOLDER, PATH, TEXT
from ttscompile.core.spec import FP32
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms, share
from ttscompile.report.facts import told_plan
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.open import CPU
from ttscompile.runtimes.random_calls import random_calls

RIVALS = ("original", "eager", "onnxruntime-dense", "onnxruntime")
"""The checkpoint with the sampler it was saved with; with the artifact's; the artifact computed in full; and the same
plan of it on the CPU, for --runtime torch."""

MOST_IN_A_ROW = 100
"""Calls of a turn, whose observations are drawn before it."""

COMPARED = 8
"""Dense calls on random observations, in another precision and in fp32."""

WORTH = 0.1
"""Share of a call's time that more threads have to save: they take their cores from the rest of the robot."""


@click.command()
@artifact_argument
@several_threads_option(
    "Threads that each contestant computes with. Of several, as in 1,2,4, the compiled policy is timed with each, and"
    " its rivals with the first."
)
@runs_option("Calls of each contestant that are counted.")
@count_option(
    "--in-a-row",
    "Calls that a contestant makes in its turn; the last one counts. Before the first, what the others did has taken"
    " the processor's caches, as a robot's other work does.",
    most=MOST_IN_A_ROW,
)
@click.option("--plan", type=TEXT, help="Plan of the compiled policy. Without this option its default plan runs.")
@runtime_options
@click.option(
    "--precision",
    type=TEXT,
    help="Of the weights; on torch of the blocks' products. Without this option it is that of the artifact, or fp32.",
)
@names_option(
    "--against",
    RIVALS,
    default="onnxruntime-dense",
    help=f"What the compiled policy is timed against, any of {', '.join(RIVALS)}. The first two run the original"
    " network in PyTorch.",
)
@click.option(
    "--checkpoint",
    type=PATH,
    help="The checkpoint that DIRECTORY was made from. The rivals 'original' and 'eager' need it.",
)
@click.option(
    "--encoders",
    type=FOLDER,
    help="For --checkpoint: the folder that 'ttscompile convert' was given by the same name, if it was.",
)
@seed_option("Seed of the observations and the noise.")
@json_option
def bench(
    directory: Path,
    threads: tuple[int, ...],
    runs: int,
    in_a_row: int,
    plan: str | None,
    runtime: str,
    device: str | None,
    precision: str | None,
    against: tuple[str, ...],
    checkpoint: Path | None,
    encoders: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Time calls of the artifact DIRECTORY and of its rivals, which take turns on the same random observations.

    Every figure is of whole calls, for one robot at a time. Warm-up calls are not counted.
    """
    if {"eager", "original"}.intersection(against) and checkpoint is None:
        raise click.UsageError("--against eager or original runs the original network: give --checkpoint FILE too.")
    if len(threads) > 1 and runtime == "torch":
        raise click.UsageError("--runtime torch has one number of threads in a process: give --threads one number.")
    console, artifact = progress(), load_artifact(directory)
    identity = artifact.manifest.identity
    with console.status("loading"):
        own = Compiled(runtime, device, precision, threads[0])
        entered = contestants(artifact, own, plan, against, checkpoint, encoders, threads[1:])
    if entered[0].plan == "dense":
        say(console, f"warning: {directory} runs dense: it is not calibrated, or --plan dense was given.")
    with console.status("timing") as status:
        measured = measure(
            entered,
            runs,
            seed,
            lambda done, total: status.update(f"timing: round {done} of {total}"),
            in_a_row=in_a_row,
        )
    error = None
    if runtime == "torch" and precision not in (None, FP32):
        with console.status(f"comparing actions in {precision} and {FP32}"):
            error = _apart(artifact, str(precision), threads[0], device)
    timed = dict(zip(threads, (m.median_ms for m in measured), strict=False))
    if as_json:
        of = {"identity": identity, "machine": fingerprint(), "threads": threads[0], "runs": runs, "runtime": runtime}
        of |= {"best_threads": fewest_threads(timed), "in_a_row": in_a_row}
        of |= {"device": device or CPU, "precision_error": error}
        print_json(of | {"contestants": [m.to_json() for m in measured]})
        return
    output, head = results(), ("", "ms a call", "quartiles", "calls/s", "speed-up", "GFLOP", "reused")
    seeing = any(m.frames_ms for m in measured)
    parts = ("prologue", *["of it frames"] * seeing, "pruner")
    output.print(table(*head, *parts, rows=[_row(m, measured[0], seeing) for m in measured]))
    say(
        output,
        f"Medians of {runs} calls, one stream, {threads[0]} thread{'s' * (threads[0] > 1)}; plan {entered[0].plan!r}."
        " Speed-up: how many times faster the first row is. Prologue and pruner: their ms of the call.",
    )
    if in_a_row > 1:
        say(output, f"A contestant makes {in_a_row} calls in a row, of which the last counts: its caches are warm.")
    if len(threads) > 1:
        best = fewest_threads(timed)
        say(output, f"Load it with threads={best}: more of these save less than {WORTH:.0%} of a call.")
    say(output, f"The first row computes {told_plan(artifact.manifest, entered[0].plan.partition('@')[0])}.")
    if seeing:
        say(
            output,
            "Every call has frames of its own; frames that are known, or prepared before it, would cost nothing.",
        )
    if error is not None:
        say(
            output,
            f"Actions of {COMPARED} dense calls in {precision} are {error['mean']:.4g} off those in {FP32} on average,"
            f" {error['p90']:.4g} at the 90th percentile, {error['largest']:.4g} at most, in their units.",
        )
    print_identity(identity, output)
    say(output, one_line(fingerprint()))


def _apart(artifact: Artifact, precision: str, threads: int, device: str | None) -> dict[str, float]:
    """How far executed actions of dense calls on torch are from those in fp32, with equal noise, in their units."""
    actions = []
    for each in (precision, FP32):
        policy = open_policy(artifact, "torch", threads, plan=artifact.plan(f"dense@{each}"), device=device)
        made = []
        for obs, noise in random_calls(artifact.manifest.spec, COMPARED, seed=0):
            policy.reset()
            made.append(policy.predict_action(obs, noise=noise)["action"])
        actions.append(np.concatenate(made))
    apart = np.abs(actions[0] - actions[1])
    means = apart.mean((1, 2))
    found = {"mean": means.mean(), "p90": np.quantile(means, 0.9), "largest": apart.max()}
    return {"calls": COMPARED, **{name: float(value) for name, value in found.items()}}


def fewest_threads(medians: Mapping[int, float]) -> int:
    """The smallest number of threads that no other one is faster than by more than ``WORTH``; ``medians`` by number."""
    bound = min(medians.values()) / (1 - WORTH)
    return min(number for number, median in medians.items() if median <= bound)


def _row(m: Measurement, compiled: Measurement, seeing: bool) -> tuple[str, ...]:
    return (
        m.label,
        ms(m.median_ms, 4),
        "..".join(ms(quartile, 4) for quartile in m.quartiles_ms),
        f"{1000 / m.median_ms:.1f}",
        "" if m is compiled else f"{m.median_ms / compiled.median_ms:.1f} x",
        "" if m.flops is None else f"{m.flops / 1e9:.3f}",
        share(m.sparsity),
        "" if m.prologue_ms is None else f"{m.prologue_ms:.2f}",
        *["" if m.frames_ms is None else f"{m.frames_ms:.2f}"] * seeing,
        "" if m.pruner_ms is None else f"{m.pruner_ms:.2f}",
    )
