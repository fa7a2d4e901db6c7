"""Demonstrations of Meta-World's tasks by its scripted experts.

    python examples/policies/metaworld/demonstrations.py -o demonstrations.npz

Behaviour cloning meets states to which no expert comes. So the hand is pushed aside now and then, for some steps, while
the expert's action stays the label. Training leaves out chunks of actions during which a push is felt.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from metaworld.policies import ENV_POLICY_MAP

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.metaworld import TASKS, MetaWorld

FIRST_SEED = 1_000_000
"""Of the demonstrations; recordings and evaluations take smaller ones."""
MAX_STEPS = 250
"""After which an expert has failed."""
AFTER_SUCCESS = 8
"""Steps that are recorded after success, so that the policy learns to stay."""
PUSH_PROBABILITY = 0.04
"""That a push begins at a step."""
PUSH_STEPS = (3, 10)
"""Shortest and longest push."""


def demonstrate(environment: MetaWorld, seed: int, task: str) -> dict[str, npt.NDArray[np.float32]] | None:
    """One episode of the expert.

    Args:
        environment: where.
        seed: of objects, goal and pushes.
        task: one of ``TASKS``.

    Returns:
        Observations ``obs [S, 42]``, the expert's actions ``action [S, 4]`` and whether the hand was pushed,
        ``pushed [S]``; None if the expert did not succeed.
    """
    rng = np.random.default_rng([seed, 1])
    experts: Mapping[str, Any] = ENV_POLICY_MAP  # each of its own class, where Meta-World says the abstract one
    expert = experts[task]()
    environment.reset(seed, task)
    rows: list[tuple[Any, Any, bool]] = []
    left, after, push = 0, 0, np.zeros(4)
    while after < AFTER_SUCCESS and len(rows) < MAX_STEPS:
        action = np.clip(expert.get_action(environment.state), -1.0, 1.0)
        if left == 0 and not environment.success and rng.random() < PUSH_PROBABILITY:
            left = int(rng.integers(PUSH_STEPS[0], PUSH_STEPS[1] + 1))
            push = np.append(rng.uniform(-1.0, 1.0, 3), 0.0)
        rows.append((environment.observe()["obs"], action, left > 0))
        environment.step(action + push if left else action)
        left = max(left - 1, 0)
        after += environment.success
    if not environment.success:
        return None
    columns = zip(("obs", "action", "pushed"), zip(*rows, strict=True), strict=True)
    return {name: np.stack(column).astype(np.float32) for name, column in columns}


@click.command()
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True)
@click.option("--episodes", default=150, show_default=True, type=click.IntRange(1), help="Of each task.")
def main(output: Path, episodes: int) -> None:
    """Write ``obs [F, 42]``, ``action [F, 4]``, ``pushed [F]`` and ``episode_ends [E]``."""
    warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")  # the experts rely on clipping
    environment = MetaWorld()
    parts: list[dict[str, npt.NDArray[np.float32]]] = []
    for number, task in enumerate(TASKS):
        tried, before = 0, len(parts)
        while len(parts) < before + episodes:
            part = demonstrate(environment, FIRST_SEED + number * 10_000 + tried, task)
            tried += 1
            if part is not None:
                parts.append(part)
        print(f"{task:26} {episodes} of {tried} episodes", flush=True)
    frames: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    ends = np.cumsum([len(part["action"]) for part in parts])
    np.savez_compressed(output, **frames, episode_ends=ends)


if __name__ == "__main__":
    main()
