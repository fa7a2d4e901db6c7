"""Evaluate policies on numbered seeds of an environment, all on the same initial states and with the same noise.

    python examples/evaluation/evaluate.py DIR:dense DIR --episodes 48 --jobs 4

What the score of an episode is, 0 to 1, its environment says. Differences are taken episode by episode, against the
first variant. A second table says of each other variant whether it is as good as the first: equivalent within the
margins, worse, or not told by so few episodes, and how many would do in four of five cases. Whoever looks at 100
episodes, and then at 400, has looked twice: ``--looks 2`` has both share the error.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import click
import numpy as np
from bootstrap import Estimate, estimate, paired_difference, paired_difference_of_shares, share
from environments import Environment, environment_class, environment_option
from episodes import Episodes
from equivalence import EQUIVALENT, SCORE_MARGIN, SUCCESS_MARGIN, Verdict, joined, verdict
from jobs import Processes, fill_cache
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import EpisodeCache, Rollout, run_episodes
from score_plot import Timed, plot_scores, time_calls
from variants import (
    Variant,
    batch_option,
    cache_folder,
    cache_option,
    first_seed_option,
    json_option,
    open_variant,
    results_console,
    run,
    runtime_option,
    threads_option,
)

from ttscompile.artifact.load import read_manifest
from ttscompile.artifact.manifest import abbreviated
from ttscompile.cli.options import ray_option
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.pool import RayPool

TIMED_CALLS = 15


@dataclass(frozen=True)
class Evaluation:
    """Figures of one variant.

    Attributes:
        label: of the variant.
        score: of an episode.
        success: share of the episodes that solved their task.
        measures: the environment's further figures.
        score_difference: against the first variant; None for the first itself.
        success_difference: likewise.
        sparsity: share of the cells that were reused, mean of all calls; None when the policy makes no reports.
        flops: mean of all calls; likewise.
        legalised: cells that had to be replaced, in all calls together.
        tasks: the same of the episodes of each task, where there are several.
        rollout: the episodes.
    """

    label: str
    score: Estimate
    success: Estimate
    measures: Mapping[str, Estimate]
    score_difference: Estimate | None
    success_difference: Estimate | None
    sparsity: float | None
    flops: float | None
    legalised: int
    tasks: Mapping[str, Evaluation]
    rollout: Rollout

    def to_json(self) -> dict[str, Any]:
        """The figures, and the score of every seed."""
        episodes = [
            {"seed": e.seed, "task": e.task, "score": e.score, "success": e.success, **e.measures, "calls": e.calls}
            for e in self.rollout.episodes
        ]
        tasks = {task: {"episodes": len(e.rollout.episodes), **e._figures()} for task, e in self.tasks.items()}
        return self._figures() | {"tasks": tasks, "episodes": episodes}

    def _figures(self) -> dict[str, Any]:
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("tasks", "rollout")}
        return {k: dataclasses.asdict(v) if isinstance(v, Estimate) else v for k, v in plain.items()} | {
            "measures": {name: dataclasses.asdict(each) for name, each in self.measures.items()}
        }


def evaluate(
    make: Callable[[], Environment],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    batch: int,
    on_done: Callable[[str, int], None] | None = None,
    caches: Sequence[EpisodeCache | None] | None = None,
) -> list[Evaluation]:
    """Run every variant on every seed.

    Args:
        make: an environment of its own for each episode.
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

        rollouts.append(run_episodes(make, variant, seeds, batch, finished, cache))
    return [summarise(variant.label, rollout, rollouts[0]) for variant, rollout in zip(variants, rollouts, strict=True)]


def summarise(label: str, rollout: Rollout, baseline: Rollout) -> Evaluation:
    """Figures of one variant's episodes, and their differences from the baseline's on the same seeds."""
    if [e.seed for e in rollout.episodes] != [e.seed for e in baseline.episodes]:
        raise ValueError(f"{label} ran other seeds than the baseline: their episodes are not paired.")
    score, success = _columns(rollout)
    base_score, base_success = _columns(baseline)
    first, episodes = rollout is baseline, rollout.episodes
    return Evaluation(
        label=label,
        score=estimate(score),
        success=share(success),
        measures={name: estimate([e.measures[name] for e in episodes]) for name in episodes[0].measures},
        score_difference=None if first else paired_difference(score, base_score),
        success_difference=None if first else paired_difference_of_shares(success, base_success),
        sparsity=float(np.mean(rollout.sparsity)) if rollout.sparsity else None,
        flops=float(np.mean(rollout.flops)) if rollout.flops else None,
        legalised=sum(rollout.legalised),
        tasks=_by_task(label, rollout, baseline),
        rollout=rollout,
    )


def _columns(rollout: Rollout) -> tuple[list[float], list[float]]:
    return [e.score for e in rollout.episodes], [float(e.success) for e in rollout.episodes]


def _by_task(label: str, rollout: Rollout, baseline: Rollout) -> dict[str, Evaluation]:
    tasks = sorted({e.task for e in rollout.episodes})
    found = {}
    for task in tasks if len(tasks) > 1 else ():
        own, base = (Rollout(tuple(e for e in r.episodes if e.task == task), ()) for r in (rollout, baseline))
        found[task] = summarise(label, own, own if rollout is baseline else base)
    return found


def verdicts_of(
    evaluations: Sequence[Evaluation], margins: tuple[float, float], looks: int = 1
) -> list[tuple[Verdict, Verdict]]:
    """Of score and of success, for each variant but the first.

    The variants share the error of 5 %, and so do the looks. The two measures of a variant need not: it is called
    equivalent only if both are.

    Args:
        looks: how often at most the variants are judged, by more episodes each time, until a verdict is as hoped.
    """
    base_score, base_success = _columns(evaluations[0].rollout)
    comparisons, found = looks * (len(evaluations) - 1), []
    for score, success in (_columns(each.rollout) for each in evaluations[1:]):
        by_score = verdict(score, base_score, margins[0], comparisons=comparisons)
        by_success = verdict(success, base_success, margins[1], shares=True, comparisons=comparisons)
        found.append((by_score, by_success))
    return found


def verdict_table(evaluations: Sequence[Evaluation], verdicts: Sequence[tuple[Verdict, Verdict]]) -> Table:
    """Whether the others are as good as the first, in a word each."""
    score, success = verdicts[0]
    title = f"as good as {evaluations[0].label}? {score.episodes} paired episodes"
    allowed = f"{EQUIVALENT}: less than {score.margin:g} of the score and {success.margin:.0%} of success is lost"
    level = f"all {len(verdicts)} rows hold with 95 %" if len(verdicts) > 1 else "with 95 % confidence"
    if (looks := score.comparisons // len(verdicts)) > 1:
        level += f", in {looks} looks together"
    table = Table(title=title, caption=f"{allowed}, {level}")
    table.add_column("variant", overflow="fold")
    for column in ("verdict", "score", "success"):
        table.add_column(column, overflow="fold")
    for e, pair in zip(evaluations[1:], verdicts, strict=True):
        table.add_row(e.label, joined(pair), *(str(each) for each in pair))
    return table


def evaluation_table(
    title: str, evaluations: Sequence[Evaluation], seeds: Sequence[int], timed: Sequence[Timed] = ()
) -> Table:
    """The figures as a table, with 95 % intervals; and times, if any were taken."""
    table = Table(title=f"{title}, {len(seeds)} episodes, seeds {seeds[0]}..{seeds[-1]}, mean and 95 % interval")
    table.add_column("variant", overflow="fold")  # paths that differ at the end only
    measures = list(evaluations[0].measures)
    for column in ("score", *measures, "success", "score, difference", "success, difference", "sparsity"):
        table.add_column(column, justify="right")
    if timed:
        table.add_column("ms a call", justify="right")
    for e, time in zip_longest(evaluations, timed):
        table.add_row(
            e.label,
            str(e.score),
            *(f"{e.measures[name].mean:.3f}" for name in measures),
            str(e.success),
            "" if e.score_difference is None else str(e.score_difference),
            "" if e.success_difference is None else str(e.success_difference),
            "" if e.sparsity is None else f"{e.sparsity:.1%}",
            *(() if time is None else (f"{time.median:.1f}",)),
        )
    return table


def task_table(evaluations: Sequence[Evaluation]) -> Table:
    """Success task by task; below the baseline's the others' differences from it."""
    table = Table(title="success of each task; in brackets 95 % intervals of the difference")
    table.add_column("task", overflow="fold")
    table.add_column("episodes", justify="right")
    for e in evaluations:
        table.add_column(e.label, justify="right", overflow="fold")
    for task, first in evaluations[0].tasks.items():
        cells = []
        for own in (e.tasks[task] for e in evaluations):
            change = own.success_difference
            cells.append(f"{own.success.mean:.3f}" + ("" if change is None else f", {change}"))
        table.add_row(task, str(len(first.rollout.episodes)), *cells)
    return table


def print_tables(
    title: str,
    evaluations: Sequence[Evaluation],
    seeds: Sequence[int],
    timed: Sequence[Timed],
    verdicts: Sequence[tuple[Verdict, Verdict]],
) -> None:
    """All that is known of the variants; tables that have nothing to say are left out."""
    console = results_console()
    console.print(evaluation_table(title, evaluations, seeds, timed))
    if evaluations[0].tasks:
        console.print(task_table(evaluations))
    if verdicts:
        console.print(verdict_table(evaluations, verdicts))


def distance_of(text: str) -> float | None:
    """How far a variant's plan is from the original, as its calibration judged it; None where none did."""
    directory, plan, *_ = *text.split(":"), ""
    manifest = read_manifest(Path(directory))
    judged = (manifest.calibration or {}).get("plans", {}).get(plan or manifest.default_plan, {})
    distance: float | None = judged.get("distance")
    return distance


looks_option = click.option(
    "--looks",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="How often it is looked at in more and more episodes, this time included. The looks share the error.",
)
margins_option = click.option(
    "--margins",
    nargs=2,
    type=click.FloatRange(0, 1, min_open=True),
    default=(SCORE_MARGIN, SUCCESS_MARGIN),
    show_default=True,
    metavar="SCORE SUCCESS",
    help="What a variant may lose and still be called equivalent to the first.",
)


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@environment_option
@click.option("--episodes", default=48, show_default=True, type=click.IntRange(1))
@first_seed_option
@batch_option
@runtime_option
@threads_option
@cache_option
@click.option("--no-cache", is_flag=True, help="Run all episodes, and keep none.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1), help="Processes that run episodes.")
@ray_option
@looks_option
@margins_option
@click.option(
    "--plot",
    "picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Draw score against the latency of a call, which is measured after the episodes.",
)
@json_option
def main(  # noqa: C901, PLR0912  # checks each option in turn
    variants: tuple[str, ...],
    environment: str,
    episodes: int,
    first_seed: int,
    batch: int,
    runtime: str,
    threads: int,
    cache: Path | None,
    no_cache: bool,
    jobs: int,
    ray: str | None,
    looks: int,
    margins: tuple[float, float],
    picture: Path | None,
    as_json: bool,
) -> None:
    """Compare artifacts and plans: DIR takes the artifact's own plan, DIR:dense is the original policy.

    With DIR:dense:pinned all calls of an episode share noise. DIR:dense:other has other noise than all others: the
    original against itself shows what chance does.
    """
    if (jobs > 1 or ray) and no_cache:
        raise click.UsageError("--jobs and --ray hand episodes over through the cache: leave out --no-cache.")
    if jobs > 1 and ray:
        raise click.UsageError("--jobs is for this machine, and --ray for a cluster: give one of them.")
    make = environment_class(environment)
    cache = cache or cache_folder(environment)
    opened = [open_variant(text, runtime, threads) for text in variants]
    seeds = range(first_seed, first_seed + episodes)
    caches = [None if no_cache else Episodes(cache, environment, v, runtime) for v in opened]
    with Progress(console=Console(stderr=True)) as progress:
        tasks = {v.label: progress.add_task(v.label, total=episodes) for v in opened}

        def finished(label: str, count: int) -> None:
            progress.update(tasks[label], completed=count)

        if jobs > 1:
            fill_cache(environment, variants, seeds, batch, runtime, cache, Processes(jobs), finished)
        elif ray is not None:
            with RayPool(ray) as pool:
                fill_cache(environment, variants, seeds, batch, runtime, cache, pool, finished)
        evaluations = evaluate(make, opened, seeds, batch, finished, caches)
    verdicts = verdicts_of(evaluations, margins, looks)
    timed = [] if picture is None else time_calls(opened, evaluations[0].rollout.episodes[0].windows, TIMED_CALLS)
    machine = fingerprint()
    identities = [one.policy.info.identity for one in opened]
    if picture is not None:
        plural = "s" * (threads > 1)
        title = f"{make.title}, {len(seeds)} paired episodes; {threads} thread{plural} a call\n{one_line(machine)}"
        plot_scores(variants, [e.score for e in evaluations], timed, picture, title)
    if as_json:
        figures = [{"identity": one, **e.to_json()} for one, e in zip(identities, evaluations, strict=True)]
        for each, time in zip(figures, timed, strict=False):
            each["latency_ms"] = dataclasses.asdict(time)
        for each, (score, success) in zip(figures[1:], verdicts, strict=True):
            by = {"score": dataclasses.asdict(score), "success": dataclasses.asdict(success)}
            each["verdict"] = {"word": joined((score, success)), **by}
        for each, text in zip(figures, variants, strict=True):
            each["distance"] = distance_of(text)
        command = shlex.join(["python", "examples/evaluation/evaluate.py", *sys.argv[1:]])
        document = {"command": command, "environment": environment, "machine": machine, "threads": threads}
        document["variants"] = figures
        click.echo(json.dumps(document, indent=2))
    else:
        print_tables(make.title, evaluations, seeds, timed, verdicts)
        for text, identity in zip(variants, identities, strict=True):
            click.echo(f"{text}: identity {abbreviated(identity)}")
    for e in evaluations:
        if e.legalised:
            click.echo(f"warning: {e.label}: {e.legalised} cells of its plans were illegal and were replaced", err=True)


if __name__ == "__main__":
    run(main)
