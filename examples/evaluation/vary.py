"""Calibrate one artifact several times, with one thing different each time, and evaluate what comes of it.

    python examples/evaluation/vary.py DIR --trajectories calls.npz -o build/vary --over episodes=2,4,8,16,32 \\
        --target-sparsity 0.8125 --max-minutes 5 --picture episodes.png

What may differ is the number of recorded ``episodes``, the ``minutes`` of calibration, or the ``seed``. A calibration
is judged by the score of numbered seeds, as ``evaluate.py`` does it, and by how far its actions are from those of the
same loop with every block computed, on what that observed in these episodes, which are the same for all. Calibrations
that were finished are kept in ``--output``, so that an interrupted command goes on where it was, and more values can be
added.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from bootstrap import Estimate, estimate
from environments import environment_class, environment_option
from episodes import Episodes
from evaluate import evaluate
from record import save_trajectories
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import Episode, action_errors
from variants import (
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

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.output import manifest_of
from ttscompile.plots.figure import new_figure, require_picture_name, write_picture
from ttscompile.trajectories import load_trajectories

AXES = {"episodes": "recorded episodes", "minutes": "minutes of calibration at most", "seed": "seed of the calibration"}
"""What may differ, and what the picture calls it."""

COMPARED = 32
"""Episodes of the dense policy whose observations the errors are of."""


@dataclass(frozen=True)
class Varied:
    """What one calibration came to.

    Attributes:
        value: of what differs.
        computed: steps of the schedule that are computed.
        minutes: that the calibration took.
        error: of its actions against the dense policy's, in their units; interval over episodes.
        score: of an episode.
        score_difference: from the dense policy's.
        success: share of the episodes.
    """

    value: float
    computed: tuple[int, ...]
    minutes: float
    error: Estimate
    score: Estimate
    score_difference: Estimate
    success: Estimate


def calibrated(
    source: Path, folder: Path, recordings: Sequence[Path], over: str, value: float, options: dict[str, Any]
) -> float:
    """Calibrate a copy of an artifact, unless it is there already.

    Returns:
        The minutes that it took.

    Raises:
        UsageError: what is there is of another artifact, of other recordings, or was calibrated otherwise.
    """
    identity, files = manifest_of(source).identity, [str(path.resolve()) for path in recordings]
    given = {"source": identity, "recordings": files, **options}
    kept = folder.with_suffix(".json")
    if kept.exists():
        record = json.loads(kept.read_text())
        if record["given"] != given:
            raise click.UsageError(
                f"{folder} was calibrated from {record['given']}, not {given}: give another --output."
            )
        return float(record["minutes"])
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)
    if over == "episodes":
        recordings = [first_episodes(folder, recordings, int(value))]
    elif over == "minutes":
        options = {**options, "max_minutes": value}
    else:
        options = {**options, "seed": int(value)}
    minutes = ttscompile.calibrate(folder, recordings, **options).seconds / 60
    kept.write_text(json.dumps({"minutes": minutes, "given": given}))
    return minutes


def first_episodes(folder: Path, recordings: Sequence[Path], count: int) -> Path:
    """A recording of the first episodes of others, beside the artifact's folder."""
    spec = load_artifact(folder).manifest.spec
    episodes = load_trajectories(recordings, spec.observations, spec.chunk.stop - spec.chunk.start)
    if len(episodes) < count:
        raise click.UsageError(f"--over episodes={count}: the recordings hold {len(episodes)}. Record more.")
    path = folder.with_name(f"{folder.name}-calls.npz")
    save_trajectories(path, [episode.observations for episode in episodes[:count]])
    return path


def draw(over: str, found: Sequence[Varied], dense: Estimate, path: Path, title: str) -> None:
    """Error and score with their intervals, over what differed."""
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    places = [one.value for one in found]
    for axes, estimates, told in (
        (left, [one.error for one in found], "action error"),
        (right, [one.score for one in found], "score"),
    ):
        spread = [[e.mean - e.low for e in estimates], [e.high - e.mean for e in estimates]]
        axes.errorbar(places, [e.mean for e in estimates], yerr=spread, fmt="o-", capsize=3, label="compiled")
        axes.set_ylabel(f"{told}, 95 % interval")
        axes.set_xlabel(AXES[over])
        if over != "seed":
            axes.set_xscale("log")
        axes.set_xticks(places, labels=[f"{place:g}" for place in places])
        axes.set_xticks([], minor=True)
        axes.grid(color="#eeeeee", linewidth=0.5)
    left.set_ylim(bottom=0)
    right.axhspan(dense.low, dense.high, color="#dddddd", zorder=0, label="dense, 95 % interval")
    right.axhline(dense.mean, color="#888888", linewidth=1, zorder=0)
    right.legend(fontsize=8, frameon=False, loc="lower right")
    figure.suptitle(title, fontsize=8)
    write_picture(figure, path)


def table(over: str, found: Sequence[Varied], dense: Estimate, success: Estimate) -> Table:
    """One row a calibration."""
    made = Table(title="calibrations that differ in one thing; 95 % intervals")
    for column in (
        AXES[over],
        "minutes",
        "computed steps",
        "action error",
        "score",
        "difference from dense",
        "success",
    ):
        made.add_column(column, justify="right")
    made.add_row("dense", "", "all", "", str(dense), "", str(success))
    for one in found:
        steps = ", ".join(map(str, one.computed))
        shown = (steps, one.error, one.score, one.score_difference, one.success)
        made.add_row(f"{one.value:g}", f"{one.minutes:.1f}", *map(str, shown))
    return made


def parsed(text: str) -> tuple[str, list[float]]:
    """What differs, and its values."""
    over, _, values = text.partition("=")
    try:
        numbers = [float(value) for value in values.split(",")]
    except ValueError:
        numbers = []
    if over not in AXES or not numbers:
        raise click.UsageError(f"--over {text}: expected one of {', '.join(AXES)}, '=' and numbers: episodes=2,4,8.")
    return over, numbers


@click.command()
@click.argument("artifact", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--trajectories", multiple=True, required=True, type=click.Path(exists=True, path_type=Path), help="Recordings."
)
@click.option("-o", "--output", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--over", required=True, metavar="NAME=VALUE,...", help=f"What differs: {', '.join(AXES)}.")
@environment_option
@click.option("--target-sparsity", type=float, help="As calibrate has it.")
@click.option("--max-minutes", default=5.0, show_default=True, help="Of each calibration.")
@click.option("--episodes", default=200, show_default=True, type=click.IntRange(1), help="To evaluate on.")
@first_seed_option
@batch_option
@picture_option
@json_option
def main(
    artifact: Path,
    trajectories: tuple[Path, ...],
    output: Path,
    over: str,
    environment: str,
    target_sparsity: float | None,
    max_minutes: float,
    episodes: int,
    first_seed: int,
    batch: int,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Calibrate copies of ARTIFACT that differ in one thing, and evaluate them on the same episodes."""
    what, values = parsed(over)
    if picture is not None:
        require_picture_name(picture)
    output.mkdir(parents=True, exist_ok=True)
    options = {"target_sparsity": target_sparsity, "max_minutes": max_minutes}
    folders = [output / f"{what}-{value:g}" for value in values]
    minutes = [
        calibrated(artifact, folder, trajectories, what, value, options)
        for folder, value in zip(folders, values, strict=True)
    ]
    dense = open_variant(f"{artifact}:{full_plan(artifact)}", "onnxruntime", 1)
    variants = [dense, *(open_variant(str(folder), "onnxruntime", 1) for folder in folders)]
    seeds, cache = range(first_seed, first_seed + episodes), cache_folder(environment)
    with Progress(console=Console(stderr=True)) as progress:
        tasks = {v.label: progress.add_task(v.label, total=episodes) for v in variants}
        found = evaluate(
            environment_class(environment),
            variants,
            seeds,
            batch,
            lambda label, done: progress.update(tasks[label], completed=done),
            [Episodes(cache, environment, v, "onnxruntime") for v in variants],
        )
    seen: Sequence[Episode] = found[0].rollout.episodes[:COMPARED]
    rows = []
    for value, folder, took, variant, one in zip(values, folders, minutes, variants[1:], found[1:], strict=True):
        error = estimate(np.nanmean(action_errors(variant, seen), axis=1).tolist())
        compiled = load_artifact(folder)
        cells = compiled.default.cells
        assert cells is not None, "the default leaves the pruner alone"
        computed = tuple(np.flatnonzero((cells == ttscompile.Source.COMPUTE).any(axis=1)).tolist())
        assert one.score_difference is not None, "the dense policy is the first"
        rows.append(Varied(value, computed, took, error, one.score, one.score_difference, one.success))
    if picture is not None:
        title = f"{environment_class(environment).title}, {episodes} paired episodes; {artifact.name}"
        draw(what, rows, found[0].score, picture, title)
    if as_json:
        document = {"environment": environment, "over": what, "dense": asdict(found[0].score)}
        click.echo(json.dumps(document | {"calibrations": [asdict(one) for one in rows]}, indent=2))
    else:
        results_console().print(table(what, rows, found[0].score, found[0].success))


if __name__ == "__main__":
    run(main)
