"""Demonstrations of the twelve tasks of ``fetch_blocks``, as arrays in folders of 150 episodes.

MUJOCO_GL=osmesa python examples/policies/vla/demonstrations.py OUT --first 0 --count 40
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import COLOURS, TASKS, FetchBlocks
from experts import act

SCENES, TASKS_OF_A_SCENE = 50, 3
"""Of one folder. All episodes of a scene begin with the same pictures."""
NOISES = (0.0, 0.1, 0.2)
"""Deviation of what is added to an action; of each three episodes of a scene one has each. What the expert wanted is
recorded."""
AFTER = 4
"""Steps that are recorded after success, so that a policy that is a little off goes on."""
SEEDS = 1_000_000
"""Seed of the first scene; an evaluation's are below."""


def episode(world: FetchBlocks, scene: int, task: str, noise: float) -> dict[str, npt.NDArray[Any]] | None:
    """Record an expert.

    Args:
        world: the environment.
        scene: seed of hand and blocks.
        task: one of ``TASKS``.
        noise: deviation of what is added to an action.

    Returns:
        By name an array with a row for each step; none if the expert failed.
    """
    random = np.random.default_rng((scene, TASKS.index(task)))
    world.reset(scene, task, scene)
    rows = dict[str, list[npt.NDArray[Any]]]()
    drift, after = np.zeros(3), 0
    while after < AFTER and not (world.done and not world.success):
        action = act(world, task)
        blocks = np.concatenate([world.block(number) for number in range(len(COLOURS))]).astype(np.float32)
        seen: dict[str, Any] = {
            "front": world.view("front"),
            "wrist": world.view("wrist"),
            "state": world.state(),
            "blocks": blocks,
        }
        for name, value in {**seen, "action": np.clip(action, -1.0, 1.0)}.items():
            rows.setdefault(name, []).append(value)
        drift = 0.7 * drift + noise * random.normal(size=3)
        world.step(action + np.array([*drift, 0.0]))
        after += world.success
    return {name: np.stack(values) for name, values in rows.items()} if world.success else None


def folder(world: FetchBlocks, out: Path, number: int) -> None:
    """Record one folder, unless it is there: ``NAME.npy`` with all frames, and ``episodes.npy``.

    ``episodes.npy`` is ``[N, 4]``: first frame, frames, number of the task, scene.
    """
    if (out / f"{number:04}").exists():
        return
    found, episodes, begin = dict[str, list[npt.NDArray[Any]]](), list[tuple[int, ...]](), 0
    for scene in range(SEEDS + number * SCENES, SEEDS + (number + 1) * SCENES):
        random = np.random.default_rng((scene, 2))
        tasks = random.choice(len(TASKS), TASKS_OF_A_SCENE, replace=False)
        for task, noise in zip(tasks, random.permutation(NOISES), strict=True):
            recorded = episode(world, scene, TASKS[task], float(noise))
            if recorded is None:
                continue
            frames = len(recorded["state"])
            episodes.append((begin, frames, int(task), scene))
            begin += frames
            for name, value in recorded.items():
                found.setdefault(name, []).append(value)
    part = out / f"{number:04}.part"
    part.mkdir(parents=True, exist_ok=True)
    for name, values in found.items():
        np.save(part / f"{name}.npy", np.concatenate(values))
    np.save(part / "episodes.npy", np.array(episodes))
    part.rename(out / f"{number:04}")
    print(f"{number}: {len(episodes)} episodes, {begin} frames", flush=True)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--every", type=int, default=1, help="to share the folders among processes")
    given = parser.parse_args()
    world = FetchBlocks()
    for number in range(given.first, given.count, given.every):
        folder(world, given.out, number)


if __name__ == "__main__":
    main()
