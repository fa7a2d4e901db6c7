"""Does it pay to begin a call with the chunk of the call before, as Falcon does (arXiv 2503.00339)?

    python examples/evaluation/warm_start.py CHECKPOINT --sampler dpmsolver++ --steps 16 --evaluations 8 --evaluations 5

A warm call begins with the chunk of the call before and computes every block of the last steps of the loop; each
number of them is a plan of the artifact. Each is compared, on paired episodes, with the whole loop and with a loop of
so few steps that begins with noise.

A warm call must react to what it sees. So each also continues a chunk with the observation of another episode, as if
the world had changed between two calls. The distance of its actions from an answer of the whole loop is divided by that
between two such answers with different noise: 1 where the chunk of before has left no trace.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from environments import Array, environment_class, environment_option
from evaluate import Evaluation, evaluate
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rollout import Episode, stacked
from variants import (
    Policy,
    Variant,
    batch_option,
    first_seed_option,
    full_plan,
    json_option,
    open_variant,
    results_console,
    run,
    seeded_noise,
    threads_option,
)

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import dense_plan

WARM = "warm"
"""What plans are called that begin with the chunk of the call before, with the number of their steps."""

OTHER = 1_000_000
"""Added to a seed for other noise."""


@dataclass(frozen=True)
class Reaction:
    """How far warm calls are from those of the whole loop, over how far these are apart with different noise.

    Attributes:
        same: with the chunk of the call before.
        changed: with the chunk of another episode.
    """

    same: float
    changed: float


def neighbours(episodes: Sequence[Episode]) -> list[int]:
    """For each episode the next one of the same task."""
    count = len(episodes)
    return [
        next(j % count for j in range(i + 1, i + count + 1) if episodes[j % count].task == episode.task)
        for i, episode in enumerate(episodes)
    ]


def reaction(warm: Policy, cold: Variant, episodes: Sequence[Episode]) -> Reaction:
    """Of calls that all episodes have, but the first; see ``Reaction``.

    Args:
        warm: the policy in question.
        cold: the whole loop.
        episodes: of the whole loop.
    """
    own, seeds, others = range(len(episodes)), [one.seed for one in episodes], neighbours(episodes)
    distances = np.zeros((2, 2))
    for call in range(1, min(one.calls for one in episodes)):
        noises = [seeded_noise(cold.noise, [seed + more for seed in seeds], call) for more in (0, OTHER)]
        for row, order in enumerate((own, others)):

            def windows(number: int, order: Sequence[int] = order) -> dict[str, Array]:
                return stacked([{key: array[number] for key, array in episodes[i].windows.items()} for i in order])

            cold.policy.reset()  # of however many episodes its last call was
            warm.reset()
            warm.predict_action(windows(call - 1, own), noise=seeded_noise(cold.noise, seeds, call - 1))
            made = warm.predict_action(windows(call), noise=noises[0])["action"]
            whole = [cold.policy.predict_action(windows(call), noise=one, plan=cold.plan)["action"] for one in noises]
            distances[row] += [np.abs(one - whole[1]).mean() for one in (made, whole[0])]
    same, changed = distances[:, 0] / distances[:, 1]
    return Reaction(float(same), float(changed))


def add_warm_plans(directory: Path, evaluations: Sequence[int]) -> None:
    """Give an artifact a plan ``warm-N`` for each number of last steps, in which every block is computed."""
    artifact = load_artifact(directory)
    base, blocks = artifact.default, len(artifact.manifest.blocks)
    plans, starts = dict(artifact.plans), dict[str, StartRecord]()
    for number in evaluations:
        loop = f"{base.loop}-last-{number}"
        starts[loop] = StartRecord(base.loop, number)
        plans[f"{WARM}-{number}"] = replace(base, loop=loop, cells=dense_plan(number, blocks), otherwise=base)
    update_plans(directory, plans, artifact.manifest.default_plan, starts=starts)


def drawn(evaluations: Sequence[Evaluation], reactions: Mapping[str, Reaction]) -> Table:
    """One row a loop."""
    table = Table(title="Calls that begin with the chunk of the call before")
    table.add_column("loop")
    for name in ("score", "difference", "success", "difference", "reaction: same", "changed"):
        table.add_column(name, justify="right")
    for one in evaluations:
        differences = [one.score_difference, one.success_difference]
        reacts = reactions.get(one.label)
        table.add_row(
            one.label,
            str(one.score),
            "" if differences[0] is None else str(differences[0]),
            str(one.success),
            "" if differences[1] is None else str(differences[1]),
            *([f"{reacts.same:.2f}", f"{reacts.changed:.2f}"] if reacts else ["", ""]),
        )
    return table


@click.command(context_settings={"show_default": True})
@click.argument("checkpoint", type=click.Path(exists=True, path_type=Path))
@click.option("--sampler", help="In place of the checkpoint's own, as of 'ttscompile convert'.")
@click.option("--steps", type=click.IntRange(2), help="Likewise.")
@click.option("--task", help="Likewise.")
@click.option("--evaluations", multiple=True, required=True, type=click.IntRange(1), help="Of a warm call.")
@click.option("--episodes", "count", default=100, type=click.IntRange(2))
@click.option("--compared", default=16, type=click.IntRange(2), help="Of these, episodes that reactions are of.")
@first_seed_option
@batch_option
@threads_option
@environment_option
@json_option
def main(
    checkpoint: Path,
    sampler: str | None,
    steps: int | None,
    task: str | None,
    evaluations: Sequence[int],
    count: int,
    compared: int,
    first_seed: int,
    batch: int,
    threads: int,
    environment: str,
    as_json: bool,
) -> None:
    """Measure warm starts of the policy in CHECKPOINT."""
    make = environment_class(environment)
    with TemporaryDirectory() as folder, Progress(console=Console(stderr=True)) as progress:

        def compiled(name: str, steps: int | None) -> Path:
            ttscompile.convert(checkpoint, Path(folder, name), sampler=sampler, steps=steps, task=task)
            return Path(folder, name)

        def opened(label: str, directory: Path, plan: str | None = None) -> Variant:
            text = f"{directory}:{plan or full_plan(directory)}"
            return replace(open_variant(text, "onnxruntime", threads), label=label)

        whole = compiled("whole", steps)
        add_warm_plans(whole, evaluations)
        cold = opened("the whole loop", whole)
        variants, warm = [cold], dict[str, Policy]()
        for number in evaluations:
            variants.append(opened(f"its last {number} steps, warm", whole, f"{WARM}-{number}"))
            warm[variants[-1].label] = variants[-1].policy
            variants.append(opened(f"{number} steps", compiled(f"few-{number}", number)))
        bar = progress.add_task("episodes", total=count * len(variants))
        done = dict.fromkeys((one.label for one in variants), 0)

        def finished(label: str, episodes: int) -> None:
            done[label] = episodes
            progress.update(bar, completed=sum(done.values()))

        results = evaluate(make, variants, range(first_seed, first_seed + count), batch, finished)
        some = results[0].rollout.episodes[:compared]
        reactions = {label: reaction(one, cold, some) for label, one in warm.items()}
    if as_json:
        reacted = {label: {"reaction": asdict(one)} for label, one in reactions.items()}
        click.echo(json.dumps([one.to_json() | reacted.get(one.label, {}) for one in results], indent=2))
    else:
        results_console().print(drawn(results, reactions))


if __name__ == "__main__":
    run(main)
