"""Evaluate policies on numbered seeds of Push-T, all on the same initial states and with the same noise.

    python examples/pusht/evaluate.py build/pusht/compiled:dense build/pusht/compiled --episodes 48 --jobs 4

The score of an episode is the original's reward: the best coverage of the goal, divided by the 0.95 that counts as
success, at most 1. Differences are taken episode by episode, against the first variant.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import click
import numpy as np
from bootstrap import Estimate, estimate, paired_difference
from episodes import Episodes
from jobs import fill_cache
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import EpisodeCache, Rollout, run_episodes
from score_plot import Timed, plot_scores, time_calls
from variants import (
    Variant,
    cache_option,
    first_seed_option,
    open_variant,
    results_console,
    run,
    runtime_option,
    threads_option,
)

from ttscompile.artifact.manifest import abbreviated
from ttscompile.cli.output import identity_of
from ttscompile.measure.machine import fingerprint, one_line

TIMED_CALLS = 15


@dataclass(frozen=True)
class Evaluation:
    """Figures of one variant.

    Attributes:
        label: of the variant.
        score: best coverage / 0.95, at most 1.
        coverage: best coverage as it is.
        success: share of the episodes that covered more than 0.95.
        score_difference: against the first variant; None for the first itself.
        success_difference: likewise.
        sparsity: share of the cells that were reused, mean of all calls; None when the policy makes no reports.
        flops: mean of all calls; likewise.
        legalised: cells that had to be replaced, in all calls together.
        rollout: the episodes.
    """

    label: str
    score: Estimate
    coverage: Estimate
    success: Estimate
    score_difference: Estimate | None
    success_difference: Estimate | None
    sparsity: float | None
    flops: float | None
    legalised: int
    rollout: Rollout

    def to_json(self) -> dict[str, Any]:
        """The figures, and the score of every seed."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "rollout"}
        figures = {k: dataclasses.asdict(v) if isinstance(v, Estimate) else v for k, v in fields.items()}
        episodes = [
            {"seed": e.seed, "score": e.score, "best_coverage": e.best_coverage, "calls": len(e.windows)}
            for e in self.rollout.episodes
        ]
        return figures | {"episodes": episodes}


def evaluate(
    variants: Sequence[Variant],
    seeds: Sequence[int],
    batch: int,
    on_done: Callable[[str, int], None] | None = None,
    caches: Sequence[EpisodeCache | None] | None = None,
) -> list[Evaluation]:
    """Run every variant on every seed.

    Args:
        variants: the first is the baseline.
        seeds: one an episode.
        batch: episodes in lockstep.
        on_done: told the variant's label and its number of finished episodes.
        caches: of the episodes of each variant; None for none.

    Returns:
        One evaluation a variant.
    """
    rollouts = []
    for variant, cache in zip(variants, caches or [None] * len(variants), strict=True):

        def finished(episodes: int, label: str = variant.label) -> None:
            if on_done is not None:
                on_done(label, episodes)

        rollouts.append(run_episodes(variant.policy, seeds, variant.noise, batch, variant.plan, finished, cache))
    return [summarise(variant.label, rollout, rollouts[0]) for variant, rollout in zip(variants, rollouts, strict=True)]


def summarise(label: str, rollout: Rollout, baseline: Rollout) -> Evaluation:
    """Figures of one variant's episodes, and their differences from the baseline's on the same seeds."""
    if [e.seed for e in rollout.episodes] != [e.seed for e in baseline.episodes]:
        raise ValueError(f"{label} ran other seeds than the baseline: their episodes are not paired.")
    score, coverage, success = _columns(rollout)
    base_score, _, base_success = _columns(baseline)
    first = rollout is baseline
    return Evaluation(
        label=label,
        score=estimate(score),
        coverage=estimate(coverage),
        success=estimate(success),
        score_difference=None if first else paired_difference(score, base_score),
        success_difference=None if first else paired_difference(success, base_success),
        sparsity=float(np.mean(rollout.sparsity)) if rollout.sparsity else None,
        flops=float(np.mean(rollout.flops)) if rollout.flops else None,
        legalised=sum(rollout.legalised),
        rollout=rollout,
    )


def _columns(rollout: Rollout) -> tuple[list[float], list[float], list[float]]:
    episodes = rollout.episodes
    return [e.score for e in episodes], [e.best_coverage for e in episodes], [float(e.success) for e in episodes]


def evaluation_table(evaluations: Sequence[Evaluation], seeds: Sequence[int], timed: Sequence[Timed] = ()) -> Table:
    """The figures as a table, with 95 % intervals; and times, if any were taken."""
    table = Table(title=f"Push-T, {len(seeds)} episodes, seeds {seeds[0]}..{seeds[-1]}, mean and 95 % interval")
    table.add_column("variant", overflow="fold")  # paths that differ at the end only
    for column in ("score", "best coverage", "success", "score, difference", "success, difference", "sparsity"):
        table.add_column(column, justify="right")
    if timed:
        table.add_column("ms a call", justify="right")
    for e, time in zip_longest(evaluations, timed):
        table.add_row(
            e.label,
            str(e.score),
            f"{e.coverage.mean:.3f}",
            str(e.success),
            "" if e.score_difference is None else str(e.score_difference),
            "" if e.success_difference is None else str(e.success_difference),
            "" if e.sparsity is None else f"{e.sparsity:.1%}",
            *(() if time is None else (f"{time.median:.1f}",)),
        )
    return table


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@click.option("--episodes", default=48, show_default=True, type=click.IntRange(1))
@first_seed_option
@click.option("--batch", default=16, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@runtime_option
@threads_option
@cache_option
@click.option("--no-cache", is_flag=True, help="Run all episodes, and keep none.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1), help="Processes that run episodes.")
@click.option(
    "--plot",
    "picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Draw score against the latency of a call, which is measured after the episodes.",
)
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of a table.")
def main(
    variants: tuple[str, ...],
    episodes: int,
    first_seed: int,
    batch: int,
    runtime: str,
    threads: int,
    cache: Path,
    no_cache: bool,
    jobs: int,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Compare artifacts and plans: DIR takes the artifact's own plan, DIR:dense computes everything."""
    if jobs > 1 and no_cache:
        raise click.UsageError("--jobs hands episodes over through the cache: leave out --no-cache.")
    opened = [open_variant(text, runtime, threads) for text in variants]
    seeds = range(first_seed, first_seed + episodes)
    caches = [None if no_cache else Episodes(cache, v, runtime) for v in opened]
    with Progress(console=Console(stderr=True)) as progress:
        tasks = {v.label: progress.add_task(v.label, total=episodes) for v in opened}

        def finished(label: str, count: int) -> None:
            progress.update(tasks[label], completed=count)

        if jobs > 1:
            fill_cache(variants, seeds, batch, runtime, cache, jobs, finished)
        evaluations = evaluate(opened, seeds, batch, finished, caches)
    timed = [] if picture is None else time_calls(opened, evaluations[0].rollout.episodes[0].windows[0], TIMED_CALLS)
    machine = fingerprint()
    identities = [identity_of(Path(text.partition(":")[0])) for text in variants]
    if picture is not None:
        plural = "s" * (threads > 1)
        title = f"Push-T, {len(seeds)} paired episodes; {threads} thread{plural} a call\n{one_line(machine)}"
        plot_scores(variants, [e.score for e in evaluations], timed, picture, title)
    if as_json:
        figures = [{"identity": one, **e.to_json()} for one, e in zip(identities, evaluations, strict=True)]
        for each, time in zip(figures, timed, strict=False):
            each["latency_ms"] = dataclasses.asdict(time)
        click.echo(json.dumps({"machine": machine, "threads": threads, "variants": figures}, indent=2))
    else:
        results_console().print(evaluation_table(evaluations, seeds, timed))
        for text, identity in zip(variants, identities, strict=True):
            click.echo(f"{text}: identity {abbreviated(identity)}")
    for e in evaluations:
        if e.legalised:
            click.echo(f"warning: {e.label}: {e.legalised} cells of its plans were illegal and were replaced", err=True)


if __name__ == "__main__":
    run(main)
