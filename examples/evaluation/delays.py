"""What latency does to a policy that is played by the executor, and what seam, margin and horizon do about it.

    python examples/evaluation/delays.py DIR --hz 50 --latency-ms 0,20,40,80 --seams replace,blend,prefix

The world takes a step each tick and never waits, not for the first chunk of an episode either: the robot stands still
until it comes. A call takes as long as ``--latency-ms`` says, in simulated time, so the result is the same on every
machine and no time is spent waiting. Latencies that are too long for the loop are played too: where there is no action,
the robot stays where it is. Seeds and differences are as in ``evaluate.py``; the baseline is the policy for which the
world waits, and which executes all actions of a chunk.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from delays_plot import plot_delays
from delays_world import Driven, Setup, drive
from environments import environment_class, environment_option
from episodes import Episodes
from evaluate import Evaluation, summarise
from jobs import Processes, fill_cache
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import Rollout, run_episodes
from variants import cache_folder, cache_option, first_seed_option, open_variant, results_console, run, runtime_option

from ttscompile.cli.output import manifest_of, print_identity

T = TypeVar("T")
SEEDS_A_JOB = 4
_opened = lru_cache(open_variant)  # one for each process


def drive_all(
    environment: str,
    text: str,
    runtime: str,
    setups: Sequence[Setup],
    seeds: Sequence[int],
    jobs: int,
    on_done: Callable[[int], None],
) -> dict[Setup, list[Driven]]:
    """Run every setup on every seed.

    Args:
        environment: its name.
        text: artifact and plan, as ``open_variant`` takes them.
        runtime: of ``ttscompile.load``; each process has one thread of arithmetic.
        setups: to run.
        seeds: of the episodes.
        jobs: processes.
        on_done: told the number of episodes that are done.
    """
    parts = [(setup, seeds[i : i + SEEDS_A_JOB]) for setup in setups for i in range(0, len(seeds), SEEDS_A_JOB)]
    found: dict[tuple[Setup, int], Driven] = {}
    # A fork of a process that has threads of onnxruntime would wait for them for ever.
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(_drive, environment, text, runtime, setup, some): setup for setup, some in parts}
        for future in as_completed(running):
            for driven in future.result():
                found[running[future], driven.episode.seed] = driven
            on_done(len(found))
    return {setup: [found[setup, seed] for seed in seeds] for setup in setups}


def _drive(environment: str, text: str, runtime: str, setup: Setup, seeds: Sequence[int]) -> list[Driven]:
    """Some episodes of one setup."""
    make = environment_class(environment)
    return [drive(make, _opened(text, runtime, 1), setup, seed) for seed in seeds]


@dataclass(frozen=True)
class Figures:
    """What one setup came to.

    Attributes:
        evaluation: against the policy for which the world waits.
        calls: of the policy in an episode, mean.
        age: ticks from the observation that an action was computed from to when it was executed: mean over episodes of
            their medians; None if there never was an action.
        bridged: share of the ticks that had an action in reserve, or the last one held, because a chunk was late.
        still: share of the ticks that had no action.
        stalls: calls of the watchdog in an episode, mean.
    """

    evaluation: Evaluation
    calls: float
    age: float | None
    bridged: float
    still: float
    stalls: float

    def to_json(self) -> dict[str, Any]:
        """The figures, and the score of every seed."""
        return {**vars(self), "evaluation": self.evaluation.to_json()}


def figures(setup: Setup, driven: Sequence[Driven], baseline: Rollout) -> Figures:
    """Figures of one setup.

    Args:
        setup: that was driven.
        driven: an episode a seed.
        baseline: of the same seeds.
    """
    rollout = Rollout(tuple(each.episode for each in driven), ())
    steps = sum(len(each.episode.actions) for each in driven)
    ages = [each.age for each in driven if each.age is not None]
    return Figures(
        evaluation=summarise(setup.label, rollout, baseline),
        calls=float(np.mean([each.episode.calls for each in driven])),
        age=float(np.mean(ages)) if ages else None,
        bridged=sum(each.bridged for each in driven) / steps,
        still=sum(each.still for each in driven) / steps,
        stalls=float(np.mean([each.stalls for each in driven])),
    )


def delays_table(world: str, found: dict[Setup, Figures], baseline: Evaluation) -> Table:
    """The figures, a setup a row, and the synchronous policy first."""
    episodes = baseline.rollout.episodes
    seeds = f"seeds {episodes[0].seed}..{episodes[-1].seed}"
    table = Table(title=f"{world}, {len(episodes)} episodes, {seeds}, mean and 95 % interval")
    table.add_column("latency, ms", justify="right")
    table.add_column("setup")
    columns = "score", "success", "score, difference", "calls", "age, ticks", "bridged", "standing still", "watchdog"
    for column in columns:
        table.add_column(column, justify="right")
    calls = np.mean([each.calls for each in episodes])
    table.add_row("", "the world waits", str(baseline.score), f"{baseline.success.mean:.3f}", "", f"{calls:.1f}")
    for setup, each in found.items():
        evaluation = each.evaluation
        table.add_row(
            f"{setup.latency_ms:g}",
            setup.label,
            str(evaluation.score),
            f"{evaluation.success.mean:.3f}",
            str(evaluation.score_difference),
            f"{each.calls:.1f}",
            "" if each.age is None else f"{each.age:.1f}",
            f"{each.bridged:.1%}",
            f"{each.still:.1%}",
            "" if setup.stall_after is None else f"{each.stalls:.1f}",
        )
    return table


def several(kind: Callable[[str], T]) -> Callable[[Any, Any, str], list[T]]:
    """A callback for an option that takes several values, with commas between; numbers from 0 on."""

    def parse(context: Any, parameter: Any, text: str) -> list[T]:
        try:
            values = [kind(each) for each in text.split(",")]
        except ValueError as error:
            raise click.BadParameter(str(error)) from error
        if any(isinstance(value, int | float) and not 0 <= value < float("inf") for value in values):
            raise click.BadParameter(f"{text!r} must be 0 or more.")
        return list(dict.fromkeys(values))

    return parse


@click.command()
@click.argument("variant", metavar="DIR[:PLAN]")
@environment_option
@click.option("--latency-ms", "latencies", default="0,30,60,300,600", show_default=True, callback=several(float))
@click.option(
    "--seams", default="replace", show_default=True, callback=several(str), help="replace, blend, ensemble, prefix."
)
@click.option("--margins", default="1", show_default=True, callback=several(int), help="Ticks.")
@click.option(
    "--horizons",
    default="0",
    show_default=True,
    callback=several(int),
    help="Actions from one call to the next; 0: as many as the policy executes.",
)
@click.option(
    "--stall-after",
    "watchdogs",
    default="0",
    show_default=True,
    callback=several(float),
    help="Seconds without movement after which one call is dense and from nothing; 0: no watchdog.",
)
@click.option(
    "--displacements/--no-displacements",
    default=True,
    show_default=True,
    help="Whether the executor knows which actions of this world are displacements.",
)
@click.option("--hz", type=click.FloatRange(min=0.1), help="Ticks a second; without this option the world's own.")
@click.option("--episodes", default=48, show_default=True, type=click.IntRange(1))
@first_seed_option
@runtime_option
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1), help="Processes, of one thread each.")
@cache_option
@click.option("--plot", "picture", type=click.Path(dir_okay=False, path_type=Path), help="Draw score against latency.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of a table.")
def main(
    variant: str,
    environment: str,
    latencies: list[float],
    seams: list[str],
    margins: list[int],
    horizons: list[int],
    watchdogs: list[float],
    displacements: bool,
    hz: float | None,
    episodes: int,
    first_seed: int,
    runtime: str,
    jobs: int,
    cache: Path | None,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Drive the policy of DIR through the executor with latencies that are given, and compare with waiting for it."""
    opened, cache = open_variant(variant, runtime, 1), cache or cache_folder(environment)
    make = environment_class(environment)
    hz = hz or make.hz
    seeds = range(first_seed, first_seed + episodes)
    channels = make.displacements if displacements else ()
    setups = [
        Setup(latency, seam, margin, horizon or None, hz, watchdog or None, channels)
        for seam, margin, horizon, watchdog, latency in product(seams, margins, horizons, watchdogs, latencies)
    ]
    for setup in setups:
        setup.settings(opened.plan or opened.policy.info.default_plan)  # refused now, not after the baseline
    with Progress(console=Console(stderr=True)) as progress:
        waiting = progress.add_task("the world waits", total=episodes)
        going = progress.add_task("the world goes on", total=episodes * len(setups))

        def waited(_: str, count: int) -> None:
            progress.update(waiting, completed=count)

        fill_cache(environment, [variant], seeds, SEEDS_A_JOB, runtime, cache, Processes(jobs), waited)
        kept = Episodes(cache, environment, opened, runtime)
        rollout = run_episodes(make, opened, seeds, SEEDS_A_JOB, cache=kept)
        driven = drive_all(
            environment, variant, runtime, setups, seeds, jobs, lambda n: progress.update(going, completed=n)
        )
    baseline = summarise("the world waits", rollout, rollout)
    found = {setup: figures(setup, each, rollout) for setup, each in driven.items()}
    identity = manifest_of(Path(variant.partition(":")[0])).identity
    if picture is not None:
        title = f"{make.title} at {hz:g} Hz, {episodes} paired episodes of {variant}; latency simulated"
        scores = {setup: each.evaluation.score for setup, each in found.items()}
        plot_delays(scores, baseline.score, picture, title)
    if as_json:
        rows = [{**vars(setup), **each.to_json()} for setup, each in found.items()]
        document = {"identity": identity, "variant": variant, "baseline": baseline.to_json(), "setups": rows}
        click.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        console = results_console()
        console.print(delays_table(make.title, found, baseline))
        print_identity(identity, console)


if __name__ == "__main__":
    run(main)
