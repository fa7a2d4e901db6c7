"""Demonstrations of the twelve tasks by Meta-World's scripted experts: ``demonstrations.py -o demonstrations.npz``.

Behaviour cloning meets states that no expert comes to. So the hand is pushed aside now and then, for some steps, while the
expert's action stays the label; a chunk of actions is a label only where no push falls into it.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
from environment import OBSERVATION, TASKS, Float64Array, FloatArray, MetaWorld, observation
from metaworld.policies import ENV_POLICY_MAP  # type: ignore[import-untyped]

FIRST_SEED = 1_000_000
"""Of the demonstrations; evaluation takes seeds below."""
AFTER_SUCCESS = 8
"""Steps that are recorded after success, so that the policy learns to stay."""
PUSH_PROBABILITY = 0.04
"""That a push begins at a step."""
PUSH_STEPS = (3, 10)
"""Shortest and longest push."""


def demonstrate(environment: MetaWorld, seed: int, task: str) -> tuple[FloatArray, FloatArray, Float64Array] | None:
    """One episode of the expert.

    Args:
        environment: where.
        seed: of objects, goal and pushes.
        task: one of ``TASKS``.

    Returns:
        Observations ``[S, 42]``, the expert's actions ``[S, 4]`` and whether the step was pushed ``[S]``; None if the
        expert did not succeed.
    """
    rng = np.random.default_rng([seed, 1])
    expert = ENV_POLICY_MAP[task]()
    environment.reset(seed, task)
    observations: list[FloatArray] = []
    actions: list[FloatArray] = []
    pushed: list[float] = []
    left, after, push = 0, 0, np.zeros(4)
    while after < AFTER_SUCCESS and len(actions) < 250:
        state = environment.states[-1]
        action = np.clip(expert.get_action(state), -1.0, 1.0)
        if left == 0 and not environment.success and rng.random() < PUSH_PROBABILITY:
            left = int(rng.integers(PUSH_STEPS[0], PUSH_STEPS[1] + 1))
            push = np.append(rng.uniform(-1.0, 1.0, 3), 0.0)
        observations.append(observation(state, TASKS.index(task)))
        actions.append(action.astype(np.float32))
        pushed.append(float(left > 0))
        environment.step(action + push if left else action)
        left = max(left - 1, 0)
        after += environment.success
    if not environment.success:
        return None
    return np.stack(observations), np.stack(actions), np.array(pushed)


def main() -> None:
    """Write ``obs [F, 42]``, ``action [F, 4]``, ``pushed [F]`` and ``episode_ends [E]``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=150, help="a task")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")  # the experts rely on clipping
    environment = MetaWorld()
    parts: list[tuple[FloatArray, FloatArray, Float64Array]] = []
    for number, task in enumerate(TASKS):
        found, tried = 0, 0
        while found < arguments.episodes:
            part = demonstrate(environment, FIRST_SEED + number * 10_000 + tried, task)
            tried += 1
            if part is not None:
                parts.append(part)
                found += 1
        steps = sum(len(actions) for _, actions, _ in parts[-found:]) / found
        print(f"{task:26} {found} of {tried} episodes, {steps:.0f} steps on average", flush=True)
    obs, action, pushed = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    assert obs.shape[1] == OBSERVATION
    np.savez_compressed(
        arguments.output,
        obs=obs,
        action=action,
        pushed=pushed.astype(bool),
        episode_ends=np.cumsum([len(actions) for _, actions, _ in parts]),
    )


if __name__ == "__main__":
    main()
