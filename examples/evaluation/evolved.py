"""EVO's search of schedules, with what episodes score as fitness, beside that with the error of the actions.

    python examples/evaluation/evolved.py DIR -t calls.npz --computed 0.3 --episodes 6 --judged 100

As EVO is published (arXiv 2607.20293), a candidate drives episodes, and the best in these has most children
(``ttscompile.rivals.evo``). As ``calibrate --learn evo`` has it, its actions on recorded calls are compared with the
original's. Both searches begin with the same schedules, and have as many. All candidates drive the same episodes, on
the same noise. The two best are then driven on other seeds, beside the original, each as it is and, where that is
better on the recorded calls, with our correction. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import click
import numpy as np
import torch
from environments import environment_class, environment_option
from evaluate import Evaluation, evaluate, evaluation_table, summarise
from rollout import run_episodes
from variants import Variant, batch_option, first_seed_option, full_plan, json_option, open_variant

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.targets import REPEATS, dense_rounds
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import base_of
from ttscompile.cli.options import count_option
from ttscompile.cli.output import print_json, progress, results_console, run, say
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.lattice import PlanArray
from ttscompile.core.plan import Plan
from ttscompile.rivals.evo import Evo, Fitness


class Driven:
    """The episodes that candidates drive.

    Args:
        variant: whose policy drives, with the plan of a candidate.
        base: the plan that candidates are in all but their cells.
        seeds: of the episodes.
    """

    def __init__(self, make: Callable[[], Any], variant: Variant, base: Plan, seeds: Sequence[int], batch: int) -> None:
        self._make, self._variant, self._base = make, variant, base
        self._seeds, self._batch = seeds, batch

    def with_plan(self, label: str, found: Found) -> Variant:
        """Whoever drives with a schedule, and its correction."""
        plan: Any = replace(self._base, cells=found.schedule, correction=found.correction)
        return replace(self._variant, label=label, plan=plan)

    def lost(self, schedule: PlanArray) -> float:
        """1, less the mean score: a ``Fitness``."""
        candidate = self.with_plan("", Found(schedule))
        driven = run_episodes(self._make, candidate, self._seeds, self._batch).episodes
        return 1 - float(np.mean([one.score for one in driven]))


def searched(name: str, task: Task, fitness: Fitness | None, population: int, generations: int) -> tuple[Found, float]:
    """The best schedule of so many generations, and seconds of the processor that one took."""
    search, begun = Evo(task, fitness, population), process_time()
    for number in range(generations):
        started = perf_counter()
        search.advance(number)
        told = f"{name}: generation {number + 1} of {generations}, {search.loss:.4f}"
        say(progress(), f"{told}, {perf_counter() - started:.1f} s")
    return replace(search.found(), error=search.loss), (process_time() - begun) / generations


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@trajectories_options()
@click.option("--computed", default=0.3, type=click.FloatRange(0, 1, min_open=True), help="Share of the cells.")
@count_option("--population", "Schedules of a generation.", default=12, least=2)
@count_option("--generations", "Of each search.", default=8)
@count_option("--episodes", "That a candidate drives.", default=6)
@count_option("--judged", "Episodes of other seeds, that the best drive.", default=100)
@count_option("--learned-calls", "Recorded calls that errors and corrections are of, at most.", default=512)
@environment_option
@first_seed_option
@batch_option
@click.option("--seed", default=0, help="Of the searches, the calls and their noise.")
@json_option
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    computed: float,
    population: int,
    generations: int,
    episodes: int,
    judged: int,
    learned_calls: int,
    environment: str,
    first_seed: int,
    batch: int,
    seed: int,
    as_json: bool,
) -> None:
    """Search with both kinds of fitness for the policy of the artifact in DIRECTORY, and drive what they find."""
    torch.set_num_threads(1)
    artifact = load_artifact(directory)
    base = base_of(artifact).exact
    view = view_of(artifact, base)
    spec, runner, recorded = view.manifest.spec, Runner(view), load_episodes(view.manifest.spec, trajectories, sources)
    chosen = sample_calls(recorded, range(len(recorded)), learned_calls, seed, REPEATS)
    calls = prepare_calls(runner.model, spec, recorded, chosen, (seed, 29))
    calls = replace(calls, path=torch.cat(list(dense_rounds(runner, calls))))
    budget = max(runner.model.blocks, round(computed * runner.model.steps * runner.model.blocks))
    task = replace(Task.of(runner, calls, budget, seed), pruner={})
    make, whole = environment_class(environment), open_variant(f"{directory}:{full_plan(directory)}", "onnxruntime", 1)
    driven = Driven(make, whole, base, range(first_seed, first_seed + episodes), batch)
    variants, costs = [whole], dict[str, float]()
    for name, fitness in (("error", None), ("episodes", driven.lost)):
        found, costs[name] = searched(name, task, fitness, population, generations)
        variants.append(driven.with_plan(name, found))
        corrected = task.corrected(found)
        if corrected.correction is not None:
            variants.append(driven.with_plan(f"{name}, corrected", corrected))
    seeds = range(first_seed + episodes, first_seed + episodes + judged)
    told = evaluate(make, variants, seeds, batch)
    named = {one.label: one for one in told}
    beside = summarise("episodes", named["episodes"].rollout, named["error"].rollout)
    if as_json:
        rows = [one.to_json() | {"episodes": None} for one in told]
        against_error = {name: beside.to_json()[name] for name in ("score_difference", "success_difference")}
        print_json({"rows": rows, "against_error": against_error, "seconds_a_generation": costs, "budget": budget})
        return
    show(told, beside, costs, seeds, f"{environment}, {budget} of {runner.model.steps * runner.model.blocks} cells")


def show(told: Sequence[Evaluation], beside: Evaluation, costs: dict[str, float], seeds: range, title: str) -> None:
    """What was found as a table, and what it took."""
    output = results_console()
    output.print(evaluation_table(title, told, seeds))
    say(output, f"Fitness of episodes, against that of errors: score {beside.score_difference}, of as many episodes.")
    shown = ", ".join(f"{name} {seconds:.1f}" for name, seconds in costs.items())
    say(output, f"Seconds of the processor that a generation took, by its fitness: {shown}.")


if __name__ == "__main__":
    run(main)
