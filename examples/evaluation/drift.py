"""Does a sparse policy get worse the longer an episode lasts?

    python examples/evaluation/drift.py DIR DIR:uniform --episodes 100 --picture drift.png

Each variant drives numbered seeds. Then its artifact answers its calls with every block of its loop computed, on what
it observed and with the same noise: the difference is the action error of the first call, of the second, and so on.
Beside it stands the score after as many calls, of the variant and with every block computed on the same seeds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
from bootstrap import Estimate, estimate
from environments import environment_class, environment_option
from episodes import Episodes
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table
from rollout import Episode, action_errors, run_episodes
from variants import (
    Variant,
    batch_option,
    cache_folder,
    first_seed_option,
    full_plan,
    json_option,
    open_variant,
    picture_option,
    results_console,
    run,
)

from ttscompile.plots.figure import new_figure, require_picture_name, write_picture

PARTS = 5
"""Of an episode, in the table."""

REACHED = 0.1
"""Share of the episodes that have to reach a call for it to be shown."""


@dataclass(frozen=True)
class Drift:
    """What became of one variant in the course of its episodes.

    Attributes:
        label: of the variant.
        errors: of each call that at least a tenth of the episodes reached.
        running: share of the episodes that were not done before each of these calls.
        scores: mean of the episodes after each of them; an episode that is done keeps its score.
        dense: the same of the dense policy.
    """

    label: str
    errors: list[Estimate]
    running: npt.NDArray[np.float64]
    scores: npt.NDArray[np.float64]
    dense: npt.NDArray[np.float64]


def measured(label: str, dense: Variant, episodes: Sequence[Episode], exact: Sequence[Episode]) -> Drift:
    """Errors and scores by the number of the call, of a variant's episodes and of those with every block computed."""
    errors = action_errors(dense, episodes)
    running = np.isfinite(errors).mean(axis=0)
    reached = int((running >= REACHED).sum())
    found = [estimate(column[np.isfinite(column)].tolist()) for column in errors.T[:reached]]
    executed = max(-(-len(e.actions) // e.calls) for e in episodes)  # of all but the last call of an episode
    own, others = (
        np.mean([[e.scores[min(len(e.scores), executed * (i + 1)) - 1] for i in range(reached)] for e in some], axis=0)
        for some in (episodes, exact)
    )
    return Drift(label, found, running[:reached], own, others)


def draw(found: Sequence[Drift], path: Path, title: str) -> None:
    """Errors, and scores, over the number of the call."""
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    for number, one in enumerate(found):
        calls, colour = np.arange(len(one.errors)), f"C{number}"
        left.plot(calls, [e.mean for e in one.errors], color=colour, label=one.label)
        left.fill_between(
            calls, [e.low for e in one.errors], [e.high for e in one.errors], color=colour, alpha=0.2, linewidth=0
        )
        right.plot(calls, one.scores, color=colour, label=one.label)
    for artifact, one in {one.label.partition(":")[0]: one for one in found}.items():
        right.plot(
            np.arange(len(one.dense)), one.dense, color="#888888", linestyle=":", label=f"{artifact}, all computed"
        )
    left.set_ylim(bottom=0)
    left.set_ylabel("action error, 95 % interval")
    right.set_ylabel("score so far")
    for axes in (left, right):
        axes.set_xlabel("call of the episode")
        axes.grid(color="#eeeeee", linewidth=0.5)
        axes.legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=8)
    write_picture(figure, path)


def table(found: Sequence[Drift]) -> Table:
    """The mean error of the calls in each part of an episode."""
    made = Table(
        title=f"action error of the calls in each {PARTS}th of the longest episodes; in brackets who got there"
    )
    made.add_column("variant", overflow="fold")
    for part in range(PARTS):
        made.add_column(f"{part + 1}", justify="right")
    for one in found:
        edges = np.linspace(0, len(one.errors), PARTS + 1).round().astype(int)
        spans = [range(low, max(high, low + 1)) for low, high in pairwise(edges)]
        cells = [(np.mean([one.errors[i].mean for i in span]), one.running[span.start]) for span in spans]
        made.add_row(one.label, *(f"{error:.3g} ({share:.0%})" for error, share in cells))
    return made


def _update(progress: Progress, task: TaskID, done: int) -> None:
    progress.update(task, completed=done)


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@environment_option
@click.option("--episodes", default=100, show_default=True, type=click.IntRange(1))
@first_seed_option
@batch_option
@picture_option
@json_option
def main(
    variants: tuple[str, ...],
    environment: str,
    episodes: int,
    first_seed: int,
    batch: int,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Compare each call of the variants with one that computes every block, by its number in the episode."""
    if picture is not None:
        require_picture_name(picture)
    make, cache = environment_class(environment), cache_folder(environment)
    seeds = range(first_seed, first_seed + episodes)
    found = list[Drift]()
    with Progress(console=Console(stderr=True)) as progress:
        for text in variants:
            directory = text.partition(":")[0]
            whole = f"{directory}:{full_plan(directory)}"
            variant, dense = (open_variant(name, "onnxruntime", 1) for name in (text, whole))
            rollouts = []
            for each in (variant, dense):
                task = progress.add_task(each.label, total=episodes)
                update = partial(_update, progress, task)
                kept = Episodes(cache, environment, each, "onnxruntime")
                rollouts.append(run_episodes(make, each, seeds, batch, update, kept).episodes)
            found.append(measured(text, dense, *rollouts))
    if picture is not None:
        draw(found, picture, f"{make.title}, {episodes} paired episodes")
    if as_json:
        calls = [
            {
                "variant": one.label,
                "errors": [asdict(e) for e in one.errors],
                "running": one.running.tolist(),
                "scores": one.scores.tolist(),
                "scores_dense": one.dense.tolist(),
            }
            for one in found
        ]
        click.echo(json.dumps({"environment": environment, "variants": calls}, indent=2))
    else:
        results_console().print(table(found))


if __name__ == "__main__":
    run(main)
