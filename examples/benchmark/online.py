"""Does it pay to decide during the call? Published criteria as they are, and frozen into a plan, by error and time.

    python examples/benchmark/online.py compiled/ --trajectories calls.npz --sparsities 0.8,0.9

A criterion (TeaCache, DBCache) is fitted to recorded calls for each share of reused cells. Then it answers held-out
calls twice: it decides at each step what to compute (``ttscompile.rivals.deciding``), and as the one plan that
calibration freezes it into. It does both once more with corrections, if they are better: that of the plan, and, where
it decides, those for each step and for how long ago one was computed (``ages``). Beside these stand what other
proposers find for the same shares, and the plans of the artifact. All take turns on one thread of onnxruntime, so that
errors can be compared at equal milliseconds. Errors are against the same loop with every step computed, and the same
noise. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch
from ages import fit_table
from rivals import default_sparsities
from searches import plan_of

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.budget import cells_of, goal_of
from ttscompile.calibration.calls import (
    FRACTION,
    draw_noise,
    load_episodes,
    observed,
    prepare_calls,
    sample_calls,
    split_episodes,
)
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.proposers import SCHEDULES
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.targets import REPEATS, dense_rounds
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import base_of
from ttscompile.cli.options import count_option, json_option, names_option
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.cli.types import Number
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.core.plan import DENSE, FULL, Plan
from ttscompile.core.spec import FloatArray, Noise, PolicySpec
from ttscompile.errors import CalibrationError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.timer import Timer
from ttscompile.rivals.deciding import Deciding, Table
from ttscompile.rivals.online import Criterion
from ttscompile.runtimes.open import open_runtime
from ttscompile.runtimes.random_calls import Observation, normalized

TOGETHER = 32
"""Calls that are answered at once where nothing is timed."""

WARM_UP = 2

Array = npt.NDArray[Any]

Answer = Callable[[Observation, Noise], tuple[FloatArray, PlanArray]]
"""Denoised samples, and the cells that they took."""


@dataclass(frozen=True)
class Row:
    """One way to answer a call.

    Attributes:
        name: of the proposer and the share of reused cells, or of the artifact's plan.
        decides: ``online``, ``frozen``, or nothing where there is nothing to decide; and whether it is corrected.
        cells: computed in a call, mean and most.
        error: mean absolute difference of the executed actions from the original's, in their units.
        ms: of the processor, median of a call.
        quartiles: of the times.
    """

    name: str
    decides: str
    cells: tuple[float, int]
    error: float
    ms: float
    quartiles: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Judged:
    """Calls of episodes that nothing was learned from: normalised observations, and the noise of each."""

    obs: Observation
    noise: Noise

    def calls(self, numbers: Sequence[int]) -> tuple[Observation, Noise]:
        """Some of them."""
        chosen = list(numbers)
        steps = None if self.noise.steps is None else self.noise.steps[:, chosen]
        return {key: one[chosen] for key, one in self.obs.items()}, Noise(self.noise.initial[chosen], steps)


class Contestants:
    """Whoever answers, by name and by when it decides.

    Attributes:
        truth: answers with every cell of the loop computed.
        tried: by name, what a criterion's errors were on calls to learn from, see ``Tabled``.
    """

    def __init__(self, artifact: Artifact, base: Plan) -> None:
        self._artifact, self._base = artifact, base
        self.answers: dict[tuple[str, str], Answer] = {}
        self.tried: dict[str, tuple[float, float, float]] = {}
        self.truth = self.add_plan("every step", "", base)

    def add_plan(self, name: str, decides: str, plan: Plan) -> Answer:
        """A plan, which its own runtime executes, each call as the first of an episode."""
        runtime = open_runtime(self._artifact, plan=plan)

        def answer(obs: Observation, noise: Noise) -> tuple[FloatArray, PlanArray]:
            sample, report = runtime.predict(obs, noise, plan)
            runtime.reset()
            return sample, report.plan

        self.answers[name, decides] = answer
        return answer

    def add_found(self, name: str, found: Found, task: Task) -> None:
        """What a search found for a task; its criterion, too, if it has one."""
        criterion = found.notes.get("criterion")
        plan = replace(self._base, cells=found.schedule, correction=found.correction, repair=True)
        self.add_plan(name, "frozen" if criterion else "", plan)
        if criterion:
            rule = Criterion.of_record(criterion)
            self._add_criterion(name, "online", rule, ())
            if (correction := task.corrected(found).correction) is not None:
                self.add_plan(name, "frozen, corrected", replace(plan, correction=correction))
            tabled = fit_table(task, rule)
            self.tried[name] = tabled.errors
            if tabled.table:
                self._add_criterion(name, "online, corrected", rule, tabled.table)

    def _add_criterion(self, name: str, decides: str, rule: Criterion, table: Table) -> None:
        deciding = Deciding(self._artifact, self._base, rule, table=table)

        def answer(obs: Observation, noise: Noise) -> tuple[FloatArray, PlanArray]:
            deciding.forget_frames()
            return deciding.predict(obs, noise)

        self.answers[name, decides] = answer


def measured(contestants: Contestants, spec: PolicySpec, judged: Judged, rounds: int) -> list[Row]:
    """Errors on all calls, and times of so many."""
    answers, count = list(contestants.answers.values()), len(judged.noise.initial)
    errors: list[list[Array]] = [[] for _ in answers]
    cells: list[list[Array]] = [[] for _ in answers]
    chunk = spec.chunk
    part = (slice(None), slice(chunk.start, chunk.stop), slice(chunk.action_dim))
    for begin in range(0, count, TOGETHER):
        given = judged.calls(range(begin, min(begin + TOGETHER, count)))
        want, _ = contestants.truth(*given)
        for answer, wrong, counted in zip(answers, errors, cells, strict=True):
            found, plans = answer(*given)
            off = np.abs(found - want).astype(np.float64)[part] / chunk.scale
            wrong.append(off.mean((1, 2)))
            counted.append((plans == Source.COMPUTE).sum((1, 2)))
    timer = Timer(len(answers), WARM_UP, process_time)  # one thread computes
    for number in range(WARM_UP + rounds):
        given = judged.calls([number % count])
        for i in timer.round():
            timer.time(i, partial(answers[i], *given))
    rows = []
    for (name, decides), off, counts, took in zip(contestants.answers, errors, cells, timer.times, strict=True):
        computed = np.concatenate(counts)
        error = float(np.concatenate(off).mean())
        many = float(computed.mean()), int(computed.max())
        rows.append(Row(name, decides, many, error, took.median, took.quartiles))
    return rows


@click.command(cls=SectionedCommand)
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@names_option(
    "--learn",
    [row.name for row in SCHEDULES],
    default="teacache,dbcache,taylorseer,interval,schedule",
    help="Have each of these propose schedules.",
)
@click.option("--sparsities", help="Shares of reused cells, such as 0.8,0.9.")
@count_option("--calls", "Judge on so many held-out calls, at most.", default=128)
@count_option("--learned-calls", "Learn from so many calls, at most.", default=256, least=2)
@count_option("--rounds", "Time so many calls of each.", default=24)
@click.option("--max-minutes", type=Number(0, 1e6), default=1.0, show_default=True, help="Of each search, about.")
@count_option("--seed", "Of the split, the noise and the searches.", default=0, least=0)
@json_option
def main(
    directory: Path,
    trajectories: tuple[Path, ...],
    sources: Sources,
    learn: tuple[str, ...],
    sparsities: str | None,
    calls: int,
    learned_calls: int,
    rounds: int,
    max_minutes: float,
    seed: int,
    as_json: bool,
) -> None:
    """Hold criteria that decide during a call against the plans that they are frozen into, in DIRECTORY's policy."""
    artifact = load_artifact(directory)
    base = base_of(artifact).exact
    view = view_of(artifact, base)
    manifest, spec = view.manifest, view.manifest.spec
    episodes = load_episodes(spec, trajectories, sources)
    split, runner = split_episodes(len(episodes), FRACTION, seed), Runner(view)
    with Bar(shown=True) as bar:
        drawn = sample_calls(episodes, split.calibration, learned_calls, seed, REPEATS)
        learned = prepare_calls(runner.model, spec, episodes, drawn, (seed, 15))
        bar.stage("calls to learn from", learned.count, 0)
        learned = replace(learned, path=torch.cat(list(dense_rounds(runner, learned))))
        places = sample_calls(episodes, split.validation, calls, seed, REPEATS)
        initial, steps = draw_noise(spec, len(places), (seed, 16))
        noise = Noise(initial.numpy(), None if steps is None else steps.numpy())
        judged = Judged(normalized(spec, observed(spec, episodes, places)), noise)
        asked = [float(one) for one in sparsities.split(",")] if sparsities else default_sparsities(manifest.steps)
        contestants, task = Contestants(artifact, base), Task.of(runner, learned, 0, seed)
        for name, plan in artifact.plans.items():
            if plan.loop == base.loop and name not in (DENSE, FULL):
                contestants.add_plan(f"the artifact's {name}", "online" if plan.pruned else "", plan)
        left_out = []
        for share in asked:
            cells = cells_of(goal_of(target_sparsity=share), manifest, False)
            for name in learn:
                bar.stage(f"{name} {share:g}", 1, 0)
                try:
                    own = replace(task, budget=cells, pruner={})
                    found, _ = plan_of(name, own, seconds=60 * max_minutes)
                    contestants.add_found(f"{name} {share:g}", found, own)
                except CalibrationError as error:
                    left_out.append(f"{name} {share:g}: {error}")
        rows = sorted(measured(contestants, spec, judged, rounds), key=lambda one: one.ms)
    if as_json:
        told = {"tables": contestants.tried, "left_out": left_out, "machine": fingerprint()}
        print_json({"rows": [asdict(one) for one in rows], **told})
        return
    output, made = results_console(), table("plan", "decides", "cells", "most", "error", "ms a call", "quartiles")
    for one in rows:
        spread = f"{one.quartiles[0]:.1f} .. {one.quartiles[1]:.1f}"
        made.add_row(
            one.name, one.decides, f"{one.cells[0]:.0f}", str(one.cells[1]), f"{one.error:.3g}", f"{one.ms:.1f}", spread
        )
    output.print(made)
    for name, errors in contestants.tried.items():
        shown = "without a correction {:.3g}, with one for each step {:.3g}, for each step and age {:.3g}".format(
            *errors
        )
        say(output, f"{name}, online, on episodes that corrections were not fitted on, normalised: {shown}.")
    say(output, *left_out, one_line(fingerprint()))
    say(
        output,
        f"Error: mean absolute difference of the executed actions, in their units, from those of {base.loop!r} with"
        f" every step computed and the same noise; {len(places)} calls of episodes that nothing was learned from."
        " Times are of the processor, so that a busy machine changes them less.",
    )


if __name__ == "__main__":
    run(main)
