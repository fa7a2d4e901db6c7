"""How much faster a calibration's parts are on more cores of a Ray cluster of this machine.

    pip install 'ttscompile[compile,ray]'
    python examples/benchmark/scaling.py compiled/ --cores 1,2

It answers calls with every block computed, of the loop that a calibration begins with and with observations that are
drawn; and it compares the schedules of one crowded family, each with a correction of its own. Every number of cores
takes its turn in every round; what counts is the ratio of the medians. The start of Ray and of its processes is not
counted; that each opens the artifact is. The answers must be the same bits, or this ends with status 1.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import torch

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Calls, prepare_calls
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.targets import dense_rounds
from ttscompile.calibration.task import Task
from ttscompile.calibration.trials import base_of
from ttscompile.pool import RayPool
from ttscompile.runtimes.random_calls import random_calls
from ttscompile.trajectories.episodes import Episode


def drawn_calls(runner: Runner, count: int) -> Calls:
    """Calls without targets, each an episode of its own."""
    spec = runner.view.manifest.spec
    episodes = [Episode("drawn", obs) for obs, _ in random_calls(spec, count, seed=0)]
    return prepare_calls(runner.model, spec, episodes, [(number, 0) for number in range(count)], (0,))


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--cores", default="1,2", show_default=True, help="Of each cluster, with commas between.")
@click.option("--calls", default=64, show_default=True, type=click.IntRange(32), help="Dense calls of a round.")
@click.option("--full-steps", default=5, show_default=True, help="Steps that each schedule of the family computes.")
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1))
def main(directory: Path, cores: str, calls: int, full_steps: int, rounds: int) -> None:
    """Time dense calls and candidates of the artifact DIRECTORY on clusters of some of this machine's cores."""
    torch.set_num_threads(1)
    artifact = load_artifact(directory)
    runner = Runner(view_of(artifact, base_of(artifact).exact))
    drawn = drawn_calls(runner, calls)
    counts = [int(each) for each in cores.split(",")]
    seconds: dict[int, list[tuple[float, float]]] = {count: [] for count in counts}
    answers = []
    for _ in range(rounds):
        for count in counts:
            with RayPool("local", cores=count) as pool:
                list(dense_rounds(runner, drawn, pool=pool))  # starts the processes, which import torch
                begun = time.perf_counter()
                path = torch.cat(list(dense_rounds(runner, drawn, pool=pool)))
                dense = time.perf_counter()
                whole = Task.of(runner, replace(drawn, path=path), 0, 0, pool).whole
                family = spacings(runner.model.steps, full_steps)
                for number in range(len(family)):
                    whole.expect(family[number:])
                errors = [whole.errors(steps).normalised for steps in family]
                seconds[count].append((dense - begun, time.perf_counter() - dense))
            answers.append((path.numpy().tobytes(), errors))
    first = np.median(seconds[counts[0]], axis=0)
    for count in counts:
        dense_s, search_s = np.median(seconds[count], axis=0)
        told = f"{calls} dense calls {dense_s:.1f} s ({first[0] / dense_s:.2f} x)"
        click.echo(f"{count} cores: {told}, {len(family)} candidates {search_s:.1f} s ({first[1] / search_s:.2f} x)")
    if any(answer != answers[0] for answer in answers):
        raise click.ClickException("the answers are not the same bits.")
    click.echo("the answers are the same bits")


if __name__ == "__main__":
    main()
