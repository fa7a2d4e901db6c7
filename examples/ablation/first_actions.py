"""Are the first actions of a chunk ready before the last? Then a late call could begin with them.

    python examples/ablation/first_actions.py DIR --trajectories calls.npz

FASTER (arXiv 2603.19199) trains a policy to denoise near actions first. Other policies have one level of noise for all.
After each evaluation of a loop, of the whole one and of DIR's plan, this takes what is known of the chunk by then, and
compares it with what the whole loop ends with, by position of the action:

- *clean* is the network's clean chunk, as the sampler's table has it,
- *fitted* a linear map, by least squares on other episodes, of the condition and of all samples and answers so far.

Distances are mean absolute differences in units of those that other noise makes at the same position. The first row has
these units: of normalised actions, which are from -1 to 1 in training, where the normaliser has their range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch
from three_parts import answered, in_three

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls, load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.trials import base_of
from ttscompile.cli.output import print_json, results_console, run, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.errors import CalibrationError
from ttscompile.runtimes.reference.model import ReferenceModel

RIDGE = 1e-3
"""Of the linear map, for each call, with features of deviation 1."""
MOST_FEATURES = 256
"""Of the condition; where it has more, the map does not read it."""

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """What is known after some evaluations.

    Attributes:
        loop: the whole one, or the plan's.
        evaluations: so far, of how many there are.
        estimate: clean, fitted, or the loop's end; or what other noise makes.
        distances: by position of the executed actions.
    """

    loop: str
    evaluations: tuple[int, int]
    estimate: str
    distances: tuple[float, ...]


@dataclass(frozen=True)
class Way:
    """Of calls: the sample before each evaluation, the answer to it, the clean chunk ``[N, E, T, D]``, and the end."""

    samples: torch.Tensor
    answers: torch.Tensor
    clean: torch.Tensor
    end: torch.Tensor


def first_actions(
    path: Path,
    trajectories: Sequence[Path],
    *,
    observation: Any = None,
    fitted: int = 1024,
    judged: int = 256,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> list[Row]:
    """Measure it. Nothing is written.

    Raises:
        CalibrationError: the default plan is not one of cells, or its weights are others than the original's.
    """
    artifact = load_artifact(path)
    base, plan = base_of(artifact).exact, artifact.default
    if plan.cells is None or plan.loop != base.loop or plan.weights != base.weights:
        raise CalibrationError(f"{path}: its default plan is no schedule in the loop {base.loop!r}; expected one.")
    view = view_of(artifact, base)
    spec, runner = view.manifest.spec, Runner(view)
    episodes = load_episodes(spec, trajectories, observation)
    fitting, learning, judging = in_three(len(episodes), seed)

    def drawn(numbers: Sequence[int], limit: int, stage: int, repeats: int) -> Calls:
        chosen = sample_calls(episodes, numbers, limit, seed, repeats)
        calls = prepare_calls(runner.model, spec, episodes, chosen, (seed, 7, stage))
        return answered(runner, calls, ("fitted", "judged", "other noise")[stage], progress)

    known = drawn((*fitting, *learning), fitted, 0, REPEATS)
    parts = [drawn(judging, judged, stage, 1) for stage in (1, 2)]  # the same calls with other noise
    ends = [_executed(runner, one.targets) for one in (known, *parts)]
    unit = np.abs(ends[2] - ends[1]).mean((0, 2))

    def distances(made: Matrix) -> tuple[float, ...]:
        return tuple((np.abs(made - ends[1]).mean((0, 2)) / unit).tolist())

    rows = [Row("", (0, view.manifest.steps), "other noise", tuple(unit.tolist()))]
    whole = list(range(view.manifest.steps))
    sparse = np.flatnonzero((plan.cells == Source.COMPUTE).all(1)).tolist()
    loops: list[tuple[str, list[int], Plan | None]] = [("whole", whole, None)]
    if len(sparse) < len(whole):
        loops.append(("plan", sparse, plan))
    for name, steps, followed in loops:
        made = [_way(runner, one, steps, followed) for one in (known, parts[0])]
        for count in range(1, len(steps) + 1):
            evaluations = count, len(steps)
            rows.append(Row(name, evaluations, "clean", distances(_executed(runner, made[1].clean[:, count - 1]))))
            features = [
                _features(runner, one, calls, count) for one, calls in zip(made, (known, parts[0]), strict=True)
            ]
            read = _fitted(features[0], ends[0].reshape(known.count, -1), features[1]).reshape(ends[1].shape)
            rows.append(Row(name, evaluations, "fitted", distances(read)))
        rows.append(Row(name, (len(steps), len(steps)), "the end", distances(_executed(runner, made[1].end))))
    return rows


def _executed(runner: Runner, samples: torch.Tensor) -> Matrix:
    return np.asarray(runner.view.manifest.spec.chunk.executed(samples).numpy(), np.float64)


def _way(runner: Runner, calls: Calls, steps: Sequence[int], plan: Plan | None) -> Way:
    """What a loop does on the way; without a plan the whole one, whose samples are known."""
    model, sampler = runner.model, runner.view.manifest.spec.sampler
    assert calls.path is not None
    with torch.no_grad():
        if plan is None:
            after = calls.path
        else:
            assert plan.cells is not None
            loop = model.denoise(calls.contexts, calls.initial, calls.noise, plan.cells, correction=plan.correction)
            after = torch.stack(loop.samples, 1)
        before = torch.cat([calls.initial[:, None], after[:, :-1]], 1)
        answers, clean = [], []
        for k in steps:
            out = model.predict(before[:, k], k, calls.contexts, lambda k, hidden: _blocks(model, k, hidden, calls))
            x0 = sampler.sample_to_x0[k] * before[:, k] + sampler.out_to_x0[k] * out
            answers.append(out)
            clean.append(x0 if sampler.clip is None else x0.clamp(-sampler.clip, sampler.clip))
    return Way(before[:, steps], torch.stack(answers, 1), torch.stack(clean, 1), after[:, -1])


def _blocks(model: ReferenceModel, k: int, hidden: torch.Tensor, calls: Calls) -> torch.Tensor:
    for b in range(model.blocks):
        hidden = hidden + model.block(b, k, hidden, calls.contexts)
    return hidden


def _features(runner: Runner, way: Way, calls: Calls, count: int) -> Matrix:
    condition = runner.model.condition(calls.contexts).flatten(1)
    known = [condition] if condition.shape[1] <= MOST_FEATURES else []
    parts = [*known, way.samples[:, :count].flatten(1), way.answers[:, :count].flatten(1)]
    return np.asarray(torch.cat(parts, 1).numpy(), np.float64)


def _fitted(known: Matrix, ends: Matrix, asked: Matrix) -> Matrix:
    """What a ridge regression of ends on what was known makes of what is asked."""
    mean, deviation = known.mean(0), known.std(0) + 1e-6
    rows, others = ((np.clip((one - mean) / deviation, -5, 5)) for one in (known, asked))
    gram = rows.T @ rows + RIDGE * len(rows) * np.eye(rows.shape[1])
    return np.asarray(ends.mean(0) + others @ np.linalg.solve(gram, rows.T @ (ends - ends.mean(0))))


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--fitted", default=1024, help="Calls that linear maps are fitted on, at most.")
@click.option("--judged", default=256, help="Calls that distances are of, at most.")
@click.option("--seed", default=0, help="Of the division of the episodes, the calls and the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path, trajectories: Sequence[Path], sources: Sources, fitted: int, judged: int, seed: int, as_json: bool
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY, and its default plan."""
    sizes = {"fitted": fitted, "judged": judged, "seed": seed}
    with Bar(shown=True) as bar:
        found = first_actions(directory, trajectories, observation=sources, **sizes, progress=bar.tell)
    if as_json:
        print_json({"rows": [asdict(row) for row in found]})
        return
    made = table("loop", "evaluations", "estimate", *(f"action {i}" for i in range(1, len(found[0].distances) + 1)))
    for row in found:
        made.add_row(row.loop, "{} of {}".format(*row.evaluations), row.estimate, *(f"{d:.2f}" for d in row.distances))
    results_console().print(made)


if __name__ == "__main__":
    run(main)
