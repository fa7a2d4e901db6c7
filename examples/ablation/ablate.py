"""What decides a plan, and where residuals come from: all combinations on one policy, at one budget.

    python examples/ablation/ablate.py compiled/ --trajectories calls.npz --computed-steps 3 --minutes 2

Every row is a way to spend the same number of computed cells a call, mean over the calls: evenly spaced or searched
steps, gates trained for all calls, and a head trained to decide for each observation, with one direction of reuse or
with all. Each is measured with and without a correction of the sampler, on windows of consecutive calls of
episodes that nothing was learned from, against the same loop with every block computed and the same noise.
``oracle.py`` says what choosing among schedules could gain.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.calls import (
    FRACTION,
    Actions,
    Calls,
    draw_noise,
    load_episodes,
    prepare_calls,
    sample_calls,
    split_episodes,
    window_of,
)
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.pruner.paper import UPDATES, Paper
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.targets import REPEATS, dense_rounds
from ttscompile.calibration.task import Found, Search, Task
from ttscompile.calibration.trials import base_of
from ttscompile.calibration.tts import Tts
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source, dense_plan, uniform_plan
from ttscompile.runtimes.plans import pruner_plan

WITH_OTHER_NOISE = 64
"""Held-out calls that are answered again, with other noise."""

RESAMPLED = 2000
"""Samples of the bootstrap over episodes."""

DIRECTIONS = {
    "TIMESTEP": (Source.TIMESTEP,),
    "FORWARD": (Source.FORWARD,),
    "ROLLOUT": (Source.ROLLOUT,),
    "all": (Source.FORWARD, Source.TIMESTEP, Source.ROLLOUT),
}
"""What a trained plan may read; TIMESTEP is allowed to all: a cell has to add something in an episode's first call."""


@dataclass(frozen=True)
class Row:
    """One way to spend the budget.

    Attributes:
        decided: how a plan comes about.
        reads: what cells read that are not computed.
        corrected: whether a correction was kept.
        error: mean absolute difference of the executed actions from those with every block computed.
        interval: 95 % interval of the error, over episodes.
        other_noise: the error as a share of what other noise changes.
        cells: computed, mean over the calls.
        most: computed in the call that computes most.
        rollout: share of the cells that read ROLLOUT.
        forward: share of the cells that read FORWARD.
        plans: how many different plans the judged calls had.
        seconds: of the search.
        updates: of the training; 0 where nothing is trained.
        trained: error of the best head that training came to, over that of what was kept in its place, on calls that it
            was not trained on: 1 if it was kept. None where nothing is trained.
    """

    decided: str
    reads: str
    corrected: bool
    error: float
    interval: tuple[float, float]
    other_noise: float
    cells: float
    most: int
    rollout: float
    forward: float
    plans: int
    seconds: float
    updates: int = 0
    trained: float | None = None


Maker = Callable[[Task], Search]


def from_corrected(task: Task, updates: int) -> Search:
    """A head that departs from searched steps, trained with their correction."""
    clock = task.clock.until(0.5)
    found, _, _ = search_plan(Tts(replace(task, clock=clock)), clock)
    runner = task.runner.corrected(found.correction)
    return Paper(replace(task, runner=runner), begin=found.notes["steps"], updates=updates)


def rows_of(directions: Sequence[str], ways: Sequence[str], updates: int) -> list[tuple[str, str, Maker]]:
    """What is measured: how a plan comes about, what it reads, and the search."""
    rows: list[tuple[str, str, Maker]] = []
    if "searched" in ways:
        rows.append(("searched steps", "TIMESTEP", Tts))
    for name in directions:
        sources = DIRECTIONS[name]
        if "gates" in ways and name != "ROLLOUT":  # a plan for all calls never computes what it would read
            rows.append(("gates for all calls", name, partial(Paper, sources=sources, observes=False, updates=updates)))
        if "refined" in ways and name == "all":
            rows.append(("head from searched steps", name, partial(from_corrected, updates=updates)))
        if "head" in ways:
            rows.append(("head for each call", name, partial(Paper, sources=sources, updates=updates)))
    return rows


@dataclass(frozen=True)
class Judge:
    """Measures plans on held-out calls; see ``Row``."""

    runner: Runner
    actions: Actions
    calls: Calls
    other_noise: float

    def row(self, decided: str, reads: str, plans: PlanArray, correction: Correction | None, seconds: float) -> Row:
        """Plans ``[N, K, blocks]`` of the judged calls, or ``[K, blocks]`` for all of them."""
        calls = self.calls
        samples = self.runner.corrected(correction).run(plans, calls)
        errors = self.actions.errors(samples, calls.targets, units=True)
        each = np.broadcast_to(plans, (calls.count, *plans.shape[-2:]))
        computed = (each == Source.COMPUTE).sum((1, 2))
        return Row(
            decided,
            reads,
            correction is not None,
            float(errors.mean()),
            interval(errors, calls.episodes),
            float(errors.mean()) / self.other_noise,
            float(computed.mean()),
            int(computed.max()),
            float((each == Source.ROLLOUT).mean()),
            float((each == Source.FORWARD).mean()),
            len({plan.tobytes() for plan in each}),
            seconds,
        )


def refreshed(task: Task, judge: Judge, steps: PlanArray) -> list[Row]:
    """The first call of a window dense, the others with a schedule: what they read then is there in either direction.

    The dense calls count, so that more cells are computed than the budget has; in all of these rows as many.
    """
    window, rows = task.calls.window, list[Row]()
    for source in (Source.TIMESTEP, Source.ROLLOUT):
        reading = np.where(steps == Source.COMPUTE, steps, np.int8(source.value))

        def made(calls: Calls, reading: PlanArray = reading) -> PlanArray:
            plans = np.repeat(reading[None], calls.count, 0)
            plans[::window] = Source.COMPUTE
            return plans

        for correction in (None, task.whole.correction_of(made)):
            rows.append(judge.row("even steps, first call dense", source.name, made(judge.calls), correction, 0.0))
    return rows


def interval(errors: np.ndarray, episodes: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean, over episodes."""
    names = np.unique(episodes)
    sums = np.array([errors[episodes == one].sum() for one in names])
    counts = np.array([(episodes == one).sum() for one in names])
    picks = np.random.default_rng(0).integers(0, len(names), (RESAMPLED, len(names)))
    low, high = np.quantile(sums[picks].sum(1) / counts[picks].sum(1), (0.025, 0.975))
    return float(low), float(high)


def measured(
    task: Task, judge: Judge, decided: str, reads: str, maker: Maker, minutes: float, kept: Path | None = None
) -> list[Row]:
    """What a search finds, with and without corrections; ``kept`` gets it, if it is an artifact."""
    begun, clock = time.monotonic(), Clock(60 * minutes)
    found, _, _ = search_plan(maker(replace(task, clock=clock)), clock)
    plain = replace(found, correction=None, pruner_correction=None)
    corrected = found if found.correction is not None else task.corrected(found)
    seconds = time.monotonic() - begun
    if kept is not None:
        keep(corrected, kept)
    rows = []
    for one in (plain, corrected):
        plans, correction = one.schedule, one.correction
        if one.pruner is not None:
            plans = pruner_plan(task.runner.logits(judge.calls, one.pruner))
            correction = one.pruner_correction
        row = judge.row(decided, reads, plans, correction, seconds)
        trained = found.notes.get("trained_error")
        share = None if trained is None else trained / found.notes["kept_error"]
        rows.append(replace(row, updates=int(found.notes.get("updates", 0)), trained=share))
    return rows


def keep(found: Found, directory: Path) -> None:
    """Have the artifact in ``directory`` execute what was found, with its correction, as the plan ``found``.

    Of a head the mean of its plans is beside it, as the plan ``mean``.
    """
    artifact = load_artifact(directory)
    base, plans = base_of(artifact), {n: p for n, p in artifact.plans.items() if n not in ("found", "mean")}
    plans["found"] = replace(base, cells=found.schedule, correction=found.correction)
    if found.pruner is not None:
        plans["mean"] = replace(base, cells=found.schedule)
        plans["found"] = replace(base, cells=None, correction=found.pruner_correction)
    notes = {"learned": ["ablation"], **found.notes}
    update_plans(directory, plans, "found", notes, pruner_weights=found.pruner, pruner_loop=base.loop)


def other_noise(runner: Runner, calls: Calls, seed: int) -> float:
    """How far two answers to one observation are apart with every block computed, in the units of the actions."""
    spec = runner.view.manifest.spec
    some = runner.select(calls, np.arange(min(WITH_OTHER_NOISE, calls.count)))
    initial, noise = draw_noise(spec, some.count, (seed, 5))
    paths = torch.cat(list(dense_rounds(runner, replace(some, initial=initial, noise=noise, path=None))))
    return float(Actions(spec).errors(paths[:, -1], some.targets, units=True).mean())


def drawn(
    runner: Runner,
    episodes: Sequence[Any],
    numbers: Sequence[int],
    most: int,
    window: int,
    seed: int,
    stage: int,
    pinned: bool,
) -> Calls:
    """Windows of consecutive calls, with what is answered if every block is computed."""
    spec = runner.view.manifest.spec
    chosen = sample_calls(episodes, numbers, most, seed, REPEATS if stage == 0 else 1, window)
    calls = prepare_calls(runner.model, spec, episodes, chosen, (seed, 9, stage), window)
    calls = pin(calls) if pinned else calls
    return replace(calls, path=torch.cat(list(dense_rounds(runner, calls))))


def pin(calls: Calls) -> Calls:
    """All calls of a window have the noise of its first."""
    first = torch.arange(calls.count) // calls.window * calls.window
    return replace(calls, initial=calls.initial[first], noise=None if calls.noise is None else calls.noise[:, first])


def show(rows: Sequence[Row], title: str) -> None:
    """Print the table."""
    table = Table(title=title)
    for name in ("decided by", "reads"):
        table.add_column(name)
    for name in ("correction", "error [95 %]", "/ other noise", "cells", "most", "plans", "trained"):
        table.add_column(name, justify="right")
    for row in rows:
        low, high = row.interval
        table.add_row(
            row.decided,
            row.reads,
            "yes" if row.corrected else "no",
            f"{row.error:.4g} [{low:.4g}, {high:.4g}]",
            f"{row.other_noise:.2f}",
            f"{row.cells:.1f}",
            str(row.most),
            str(row.plans),
            "" if row.trained is None else f"{row.trained:.2f}",
        )
    Console(width=140).print(table)


@click.command(context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("--trajectories", multiple=True, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--computed-steps", default=3.0, help="The budget: computed cells of a call, in whole steps.")
@click.option("--minutes", default=2.0, help="Of each search, at most.")
@click.option("--updates", default=UPDATES, help="Of each training, at most.")
@click.option("--learned", default=512, help="Calls to learn from, at most.")
@click.option("--judged", default=256, help="Held-out calls, at most.")
@click.option("--direction", "directions", multiple=True, type=click.Choice(list(DIRECTIONS)), default=list(DIRECTIONS))
@click.option(
    "--way",
    "ways",
    multiple=True,
    type=click.Choice(["searched", "gates", "head", "refined", "refreshed"]),
    default=["searched", "gates", "head", "refined", "refreshed"],
)
@click.option("--pinned", is_flag=True, help="All calls of a window have the noise of its first.")
@click.option("--seed", default=0)
@click.option("--keep", "kept", type=click.Path(path_type=Path), help="Copy the artifact there, with the last plan.")
@click.option("--json", "path", type=click.Path(path_type=Path), help="Write the rows there, too.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    computed_steps: float,
    minutes: float,
    updates: int,
    learned: int,
    judged: int,
    directions: Sequence[str],
    ways: Sequence[str],
    pinned: bool,
    seed: int,
    kept: Path | None,
    path: Path | None,
) -> None:
    """Measure all rows on the artifact in DIRECTORY."""
    artifact = load_artifact(directory)
    spec, progress = artifact.manifest.spec, Console(stderr=True)
    runner = Runner(view_of(artifact, base_of(artifact).exact))
    budget = round(computed_steps * runner.model.blocks)
    episodes = load_episodes(spec, trajectories, None)
    split = split_episodes(len(episodes), FRACTION, seed)
    window = window_of(episodes, split)
    sets = [
        drawn(runner, episodes, numbers, most, window, seed, stage, pinned)
        for stage, (numbers, most) in enumerate(((split.calibration, learned), (split.validation, judged)))
    ]
    task = Task.of(runner, sets[0], budget, seed)
    judge = Judge(runner, task.actions, sets[1], other_noise(runner, sets[1], seed))
    even = uniform_plan(runner.model.steps, runner.model.blocks, -(-budget // runner.model.blocks))
    rows = [judge.row("even steps", "TIMESTEP", even, None, 0.0)]
    if "refreshed" in ways:
        rows += refreshed(task, judge, even)
    if kept is not None:
        shutil.copytree(directory, kept)
    for decided, reads, maker in rows_of(directions, ways, updates):
        rows += measured(task, judge, decided, reads, maker, minutes, kept)
        progress.print(rows[-2], rows[-1], sep="\n")
    flops = runner.view.manifest.flops
    share = flops.pruner / flops.call(dense_plan(runner.model.steps, runner.model.blocks), False)
    if path is not None:
        told: Mapping[str, Any] = {
            "computed_steps": computed_steps,
            "cells": runner.model.steps * runner.model.blocks,
            "calls": [one.count for one in sets],
            "window": window,
            "pinned": pinned,
            "pruner_share": share,
            "rows": [asdict(row) for row in rows],
        }
        path.write_text(json.dumps(told, indent=2))
    show(rows, f"{budget} of {runner.model.steps * runner.model.blocks} cells, windows of {window} calls")
    print(f"A head costs {share:.4%} of the FLOPs of a call that computes every block.")


if __name__ == "__main__":
    main()
