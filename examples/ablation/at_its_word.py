"""The paper's training at its word, at its own scale: thousands of updates of a head, in the original's loop.

    python examples/ablation/decoder_head.py CHECKPOINT decoder/
    python examples/ablation/at_its_word.py decoder/ --trajectories calls.npz --training paper --updates 3000

One call trains one head and says how far its plans are from the dense policy on held-out calls, with and without a
correction. ``--training paper`` is that of the authors' code: AdamW, the mean error of the chunk, and how far the share
of reused cells is from the target. ``--training ours`` is that of ``tts-paper``: computing has a price, the samples
after every step count, and training begins with whole steps, twice as many as the budget has.

Where cells may read ROLLOUT, the first call of each window is dense, as theirs is after a reset; errors and cells are
those of the other calls, in all rows.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from ablate import DIRECTIONS, Row, drawn, interval, keep, other_noise
from head_training import EVERY, START, Recipe, Training, later
from rich.console import Console

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import FRACTION, Calls, load_episodes, split_episodes, window_of
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import base_of
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import PlanArray, Source, uniform_plan, whole_steps_plan


def crowded(task: Task, count: int) -> Sequence[int]:
    """So many whole steps, even or crowded towards the end: those with the least error without a correction."""
    some = task.runner.select(task.calls, np.arange(min(128, task.calls.count)))
    model = task.runner.model
    tried = [
        (task.error(whole_steps_plan(model.steps, model.blocks, s), some), s) for s in spacings(model.steps, count)
    ]
    return min(tried)[1]


def judge(
    task: Task, calls: Calls, noise: float, told: tuple[str, str], plans: PlanArray, correction: Correction | None
) -> Row:
    """How far plans are from the dense policy: in the later calls of each window."""
    runner, numbers = task.runner.corrected(correction), later(calls)
    each = np.broadcast_to(plans, (calls.count, *plans.shape[-2:]))
    errors = task.actions.errors(runner.run(plans, calls), calls.targets, units=True)[numbers]
    some, mean = each[numbers], float(errors.mean())
    computed = (some == Source.COMPUTE).sum((1, 2))
    return Row(
        decided=told[0],
        reads=told[1],
        corrected=correction is not None,
        error=mean,
        interval=interval(errors, calls.episodes[numbers]),
        other_noise=mean / noise,
        cells=float(computed.mean()),
        most=int(computed.max()),
        rollout=float((some == Source.ROLLOUT).mean()),
        forward=float((some == Source.FORWARD).mean()),
        plans=len({plan.tobytes() for plan in some}),
        seconds=0.0,
    )


def reference_rows(task: Task, calls: Calls, noise: float, count: int) -> tuple[list[Row], Found]:
    """Even and crowded whole steps, without and with a correction; and the last of these."""
    model, rows = task.runner.model, list[Row]()
    even = np.flatnonzero((uniform_plan(model.steps, 1, count) == Source.COMPUTE)[:, 0]).tolist()
    for name, steps in (("even steps", even), ("crowded steps", crowded(task, count))):
        found = task.whole_steps(steps)
        for correction in (None, found.correction):
            rows.append(judge(task, calls, noise, (name, "TIMESTEP"), found.schedule, correction))
    return rows, found


def train(training: Training, updates: int, minutes: float, tell: Callable[[Mapping[str, float]], None]) -> float:
    """All updates, or as many as there is time for; the seconds that they took."""
    begun = time.monotonic()
    told = 0
    while training.done < updates and time.monotonic() - begun < 60 * minutes:
        training.update()
        if time.monotonic() - begun >= 60 * minutes and training.done % EVERY and training.done < updates:
            training.compare()  # the last head counts, too
        for line in training.told[told:]:
            tell({**line, "seconds": time.monotonic() - begun})
        told = len(training.told)
    return time.monotonic() - begun


@click.command(context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("-t", "--trajectories", multiple=True, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--computed-steps", default=5, help="The budget: computed cells of a call, in whole steps.")
@click.option(
    "--training", type=click.Choice(["paper", "ours", "none"]), default="paper", help="none: whole steps alone."
)
@click.option("--direction", type=click.Choice(list(DIRECTIONS)), default="TIMESTEP", help="What cells may read.")
@click.option("--correction", "corrected", is_flag=True, help="Correct the sampler while the head is trained.")
@click.option("--detached", is_flag=True, help="Ours: gates have no part of what later cells read of the caches.")
@click.option("--rate", default=1.0, help="The paper's: times their learning rate.")
@click.option("--sparse-stream", is_flag=True, help="Compute what cells would have computed, as they do; slower.")
@click.option("--updates", default=3000)
@click.option("--minutes", default=600.0, help="Of the training, at most.")
@click.option("--learned", default=512, help="Calls to learn from, at most.")
@click.option("--judged", default=256, help="Held-out calls, at most.")
@click.option("--seed", default=0)
@click.option("--keep", "kept", type=click.Path(path_type=Path), help="Copy the artifact there, with what was found.")
@click.option("--json", "path", type=click.Path(path_type=Path), help="Write the rows there, too.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    computed_steps: int,
    training: str,
    direction: str,
    corrected: bool,
    detached: bool,
    rate: float,
    sparse_stream: bool,
    updates: int,
    minutes: float,
    learned: int,
    judged: int,
    seed: int,
    kept: Path | None,
    path: Path | None,
) -> None:
    """Train the head of the artifact in DIRECTORY, and measure it."""
    artifact, progress = load_artifact(directory), Console(stderr=True, width=200)
    runner = Runner(view_of(artifact, base_of(artifact).exact))
    spec, budget = artifact.manifest.spec, computed_steps * runner.model.blocks
    episodes = load_episodes(spec, trajectories, None)
    split = split_episodes(len(episodes), FRACTION, seed)
    window = window_of(episodes, split)
    sets = [
        drawn(runner, episodes, numbers, most, window, seed, stage, False)
        for stage, (numbers, most) in enumerate(((split.calibration, learned), (split.validation, judged)))
    ]
    task, noise = Task.of(runner, sets[0], budget, seed), other_noise(runner, sets[1], seed)
    told: dict[str, Any] = {"calls": [one.count for one in sets], "training": training, "corrected": corrected}
    if training == "none":
        rows, found = reference_rows(task, sets[1], noise, computed_steps)
    else:
        begin = crowded(task, START * computed_steps) if training == "ours" else [0]
        recipe = Recipe(
            DIRECTIONS[direction],
            training == "paper",
            corrected,
            updates,
            begin,
            detached=detached,
            rate=rate,
            sparse_stream=sparse_stream,
        )
        one = Training(task, recipe)
        seconds = train(one, updates, minutes, progress.print)
        found = one.found()
        head = found.pruner or {}
        correction = task.whole.correction_of(lambda calls: one.plans(calls, head))  # that of the training is older
        named, plans = f"head, {training}'s training" + ", corrected" * corrected, one.plans(sets[1], head)
        rows = [judge(task, sets[1], noise, (named, direction), plans, each) for each in (None, correction)]
        rows = [replace(row, seconds=seconds, updates=one.done) for row in rows]
        told["progress"], found = one.told, replace(found, pruner_correction=correction)
    if kept is not None:
        shutil.copytree(directory, kept)
        keep(found, kept)
    told["rows"] = [asdict(row) for row in rows]
    if path is not None:
        path.write_text(json.dumps(told, indent=2))
    for row in rows:
        progress.print(row)


if __name__ == "__main__":
    main()
