"""Pictures of Push-T as gym-pusht draws them: of a running environment, or of any states.

    python examples/policies/pixels/pictures.py pusht_demonstrations.npz -o build/policies/pictures.npz --drawn 100000

draws the demonstrations again from their states, and other states beside them, on which an encoder can learn where the
block is. The pictures are those of the environment ``pusht-pixels``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import gymnasium
import numpy as np
import numpy.typing as npt

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.pusht import place
from environments.pusht_pixels import SIZE


def pictures(states: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """Pictures of states ``[N, 5]`` (agent x, y; block x, y, angle): uint8 ``[N, SIZE, SIZE, 3]``."""
    gym = gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True)
    gym.reset(seed=0)
    world: Any = gym.unwrapped
    made = np.empty((len(states), SIZE, SIZE, 3), np.uint8)
    for into, state in zip(made, states, strict=True):
        place(world, state)
        into[:] = world._get_img(world._draw(), SIZE, SIZE)
    return made


def drawn_states(demonstrated: npt.NDArray[np.float64], count: int, seed: int) -> npt.NDArray[np.float64]:
    """States around the demonstrated ones, and a quarter from all over the table: ``[count, 5]``."""
    generator = np.random.default_rng(seed)
    near = demonstrated[generator.integers(len(demonstrated), size=count)]
    near = near + generator.normal(size=near.shape) * [30.0, 30.0, 15.0, 15.0, 0.15]
    low, high = [50.0, 50.0, 100.0, 100.0, -np.pi], [450.0, 450.0, 400.0, 400.0, np.pi]
    anywhere = generator.uniform(low, high, size=near.shape)
    chosen = np.where(generator.random((count, 1)) < 0.25, anywhere, near)
    chosen[:, :4] = np.clip(chosen[:, :4], 15.0, 497.0)
    return chosen


@click.command()
@click.argument("demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option("--drawn", default=100_000, show_default=True, type=click.IntRange(0), help="Other states.")
@click.option("--seed", default=0, show_default=True)
def main(demonstrations: Path, out: Path, drawn: int, seed: int) -> None:
    """Write the pictures of the demonstrations' frames, in order, and of other states with these."""
    with np.load(demonstrations) as data:
        demonstrated = data["state"].astype(np.float64)
    others = drawn_states(demonstrated, drawn, seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(out, demonstrated=pictures(demonstrated), drawn=pictures(others), states=others)


if __name__ == "__main__":
    main()
