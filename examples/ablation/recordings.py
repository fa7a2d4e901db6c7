"""Which recorded calls to learn from, and how many episodes: does it pay to choose them?

    python examples/ablation/recordings.py compiled/ --trajectories calls.npz --step 0 --step 7 --step 9

Corrections of one schedule are fitted on as many calls of more and more recorded episodes, chosen in three ways, and
judged on calls of other episodes, with the same noise:

- at random, as calibration does it;
- to cover what was recorded: each call is the one whose condition is furthest from those that were chosen before;
- half of them at random, the others where a correction that was fitted on those is worst. It costs the original's
  answers to twice as many calls.

Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
import torch
from three_parts import answered

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import FRACTION, Actions, Calls, load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.progress import Bar, Progress
from ttscompile.calibration.regression import Components
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.task import Task
from ttscompile.calibration.trials import base_of
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.correction import COMPONENTS, numbers_of
from ttscompile.core.lattice import PlanArray
from ttscompile.errors import CalibrationError

RANDOM, COVER, WORST = "at random", "to cover", "the worst"
WAYS = (RANDOM, COVER, WORST)


@dataclass(frozen=True)
class Row:
    """What corrections are worth that were fitted on calls of so many episodes.

    Attributes:
        episodes: to learn from.
        calls: learned from.
        reads: whether corrections read the observation, as calibration decides it for the random ones.
        errors: mean over the draws of the episodes, by way; in the units of the actions.
        gain: share of the random ones' error that a way saves, by way: mean over the draws, least and most.
    """

    episodes: int
    calls: int
    reads: bool
    errors: dict[str, float]
    gain: dict[str, tuple[float, float, float]]


def chosen_to_cover(condition: torch.Tensor, count: int) -> np.ndarray:
    """Numbers of ``count`` of the rows ``[N, M]``, each the furthest from those before; the first from their mean."""
    most = min(COMPONENTS, numbers_of([tuple(condition.shape[1:])]))
    values = Components.of(condition, most).values
    chosen = [int((values - values.mean(0)).norm(dim=1).argmax())]
    apart = (values - values[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(values)):
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, (values - values[chosen[-1]]).norm(dim=1))
    return np.array(chosen)


class Study:
    """The schedule on the calls of some episodes."""

    def __init__(self, directory: Path, trajectories: Sequence[Path], sources: Sources, steps: Sequence[int]) -> None:
        artifact = load_artifact(directory)
        view = view_of(artifact, base_of(artifact).exact)
        self.spec, self.runner = view.manifest.spec, Runner(view)
        self.actions = Actions(self.spec)
        self.episodes = load_episodes(self.spec, trajectories, sources)
        self.steps = tuple(sorted({0, *steps}))
        if self.steps[-1] >= self.runner.model.steps:
            raise CalibrationError(
                f"expected computed steps below {self.runner.model.steps}, of the loop; found {self.steps[-1]}."
            )

    def answers(self, numbers: Sequence[int], count: int, seed: int, what: str, progress: Progress) -> Calls:
        """Calls of some episodes and what the original answers to them."""
        chosen = sample_calls(self.episodes, numbers, count, seed, REPEATS)
        calls = prepare_calls(self.runner.model, self.spec, self.episodes, chosen, (seed, 11, *numbers[:1]))
        return answered(self.runner, calls, what, progress)

    def errors(self, plan: PlanArray, fitted: Calls, judged: Calls, reads: bool) -> np.ndarray:
        """Of each judged call, with the correction that the others give."""
        correction = fit_correction(self.runner, plan, fitted, reads)
        found = self.runner.corrected(correction).run(plan, judged)
        return self.actions.errors(found, judged.targets, units=True).astype(np.float64)

    def row(
        self, count: int, limit: int, draws: int, held_out: Sequence[int], judged: Calls, progress: Progress
    ) -> Row:
        """One row; ``held_out`` are the numbers of the episodes that are judged on."""
        others = [n for n in range(len(self.episodes)) if n not in set(held_out)]
        errors: dict[str, list[float]] = {way: [] for way in WAYS}
        reads = False
        for draw in range(draws):
            numbers = np.random.default_rng((draw, 12, count)).permutation(others)[:count].tolist()
            pool = self.answers(numbers, 2 * limit, draw, f"{count} episodes, draw {draw}", progress)
            first = np.arange(min(limit, pool.count))
            task = Task.of(self.runner, self.runner.select(pool, first), 0, draw)
            plan, reads = task.whole.plan(self.steps), task.whole.reads(len(self.steps))
            half = first[: len(first) // 2]
            rest = np.arange(len(half), pool.count)
            missed = self.errors(plan, self.runner.select(pool, half), self.runner.select(pool, rest), reads)
            worst = rest[np.argsort(-missed)[: len(first) - len(half)]]
            cover = chosen_to_cover(self.runner.model.condition(pool.contexts), len(first))
            for way, which in ((RANDOM, first), (COVER, cover), (WORST, np.concatenate([half, worst]))):
                errors[way].append(float(self.errors(plan, self.runner.select(pool, which), judged, reads).mean()))
        gains = {way: 1 - np.array(errors[way]) / np.array(errors[RANDOM]) for way in WAYS[1:]}
        return Row(
            count,
            len(first),
            reads,
            {way: float(np.mean(each)) for way, each in errors.items()},
            {way: (float(each.mean()), float(each.min()), float(each.max())) for way, each in gains.items()},
        )


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--step", "steps", multiple=True, type=int, required=True, help="That the schedule computes, beside 0.")
@click.option("--episodes", "counts", multiple=True, default=(2, 4, 8, 16, 32, 64), help="To learn from.")
@click.option("--calls", default=384, help="To learn from, at most.")
@click.option("--judged", default=384, help="Calls of other episodes, to judge on, at most.")
@click.option("--draws", default=3, help="Of the episodes, for each number of them.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    steps: tuple[int, ...],
    counts: tuple[int, ...],
    calls: int,
    judged: int,
    draws: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    study = Study(directory, trajectories, sources, steps)
    total = len(study.episodes)
    held_out = np.random.default_rng(13).permutation(total)[: max(1, round(total * FRACTION))].tolist()
    most = total - len(held_out)
    rows = []
    with Bar(shown=True) as bar:
        others = study.answers(held_out, judged, 0, "held-out episodes", bar.tell)
        for count in sorted({min(one, most) for one in counts}):
            rows.append(study.row(count, calls, draws, held_out, others, bar.tell))
    if as_json:
        print_json({"rows": [asdict(one) for one in rows]})
        return
    show(rows, held_out, others.count)


def show(rows: Sequence[Row], held_out: Sequence[int], judged: int) -> None:
    """What was found as a table."""
    output = results_console()
    made = table("episodes", "calls", *(f"error, {way}" for way in WAYS), *(f"gain, {way}" for way in WAYS[1:]))
    for one in rows:
        gains = (f"{100 * m:.0f} % ({100 * low:.0f} .. {100 * high:.0f})" for m, low, high in one.gain.values())
        made.add_row(str(one.episodes), str(one.calls), *(f"{one.errors[way]:.4g}" for way in WAYS), *gains)
    output.print(made)
    say(
        output,
        f"Error: mean absolute difference of the executed actions, in their units, from those of the dense policy with"
        f" the same noise; {judged} calls of {len(held_out)} other episodes. Gain: over calls at random; brackets hold"
        " the least and the most of the draws of episodes.",
    )


if __name__ == "__main__":
    run(main)
