"""Do gradients of gates say which cells are worth computing? One after the other is computed, and the error measured.

    python examples/ablation/gate_checks.py compiled/ --trajectories calls.npz --computed-steps 5

Beside evenly spaced whole steps one more cell is computed, and the mean error of the chunk changes. The gradient of its
gates had said by how much: as the authors' code has it, where residuals in caches are detached; with what the dense
call would have computed in the cell, in place of the sparse one; and of that with what later cells read of the caches.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
from ablate import drawn
from deciding import rank_correlation
from gate_gradients import GateGradients
from torch import Tensor

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import FRACTION, Calls, load_episodes, split_episodes
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.trials import base_of
from ttscompile.core.lattice import Source, uniform_plan

Numbers = npt.NDArray[np.float64]


def wrong(samples: Sequence[Tensor], calls: Calls) -> Tensor:
    """The mean error of the chunk."""
    return (samples[-1] - calls.targets).abs().mean()


def predicted(runner: Runner, calls: Calls, steps: int, through_caches: bool, sparse_stream: bool) -> Numbers:
    """By how much computing a cell, in place of reusing it, changes the error to first order, ``[K, blocks]``."""
    of = GateGradients(runner, calls, (Source.TIMESTEP,), through_caches, sparse_stream)
    plan = uniform_plan(runner.model.steps, runner.model.blocks, steps)
    _, gates = of(np.repeat(plan[None], calls.count, 0), np.arange(calls.count), wrong)
    return np.asarray((gates[..., Source.COMPUTE] - gates[..., Source.TIMESTEP]).sum(0).double().numpy())


def measured(runner: Runner, calls: Calls, steps: int, cells: Sequence[tuple[int, int]]) -> Numbers:
    """By how much it does."""
    plan = uniform_plan(runner.model.steps, runner.model.blocks, steps)
    errors = list[float]()
    for cell in (None, *cells):
        one = plan.copy()
        if cell is not None:
            one[cell] = Source.COMPUTE
        errors.append(float(wrong([runner.run(one, calls)], calls)))
    return np.array(errors[1:]) - errors[0]


@click.command(context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("-t", "--trajectories", multiple=True, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--computed-steps", default=5)
@click.option("--calls", "count", default=32)
@click.option("--cells", default=96, help="That are computed one after the other.")
@click.option("--seed", default=0)
def main(directory: Path, trajectories: Sequence[Path], computed_steps: int, count: int, cells: int, seed: int) -> None:
    """Measure it for the artifact in DIRECTORY."""
    artifact = load_artifact(directory)
    runner = Runner(view_of(artifact, base_of(artifact).exact))
    episodes = load_episodes(artifact.manifest.spec, trajectories, None)
    numbers = split_episodes(len(episodes), FRACTION, seed).calibration
    calls = drawn(runner, episodes, numbers, count, 1, seed, 0, False)
    plan = uniform_plan(runner.model.steps, runner.model.blocks, computed_steps)
    free = np.argwhere(plan != Source.COMPUTE)
    chosen = free[np.random.default_rng((seed, 7)).permutation(len(free))[:cells]]
    places = [(int(k), int(b)) for k, b in chosen]
    change = measured(runner, calls, computed_steps, places)
    click.echo(f"{len(places)} cells, {calls.count} calls: one more lowers the error in {np.mean(change < 0):.0%}")
    ways = (
        ("as the authors' code has it", False, True),
        ("with what the dense call computes", False, False),
        ("with what later cells read, too", True, False),
    )
    for name, through, beside in ways:
        found = predicted(runner, calls, computed_steps, through, beside)[tuple(chosen.T)]
        right = np.mean((found < 0) == (change < 0))
        click.echo(f"gradient {name}: rank correlation {rank_correlation(found, change):.2f}, right sign {right:.0%}")


if __name__ == "__main__":
    main()
