"""What lerobot itself answers with a saved policy, for the tests: its observations, its noise, its executed actions.

    python examples/policies/answers.py flow/policy build/policies/flow -o flow/answers.npz

lerobot is run from the folder that has the whole encoder (``train.py``'s ``--out``): the saved policy has only its
configuration.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

sys.path[1:1] = [str(Path(__file__).parents[1] / "evaluation")]

from environments import environment_class, environment_option  # noqa: E402
from multi_task_dit import TASK  # noqa: E402

WINDOWS, SEED = 4, 200_000


@click.command()
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(dir_okay=False, path_type=Path))
@environment_option
def main(directory: Path, folder: Path, out: Path, environment: str) -> None:
    """Write windows ``[N, 2, ...]`` by key, ``noise [N, T, D]`` and ``action [N, Ta, D]``."""
    directory, out = directory.resolve(), out.resolve()
    os.chdir(folder)
    torch.manual_seed(SEED)
    policy = MultiTaskDiTPolicy.from_pretrained(directory).eval()
    before = PolicyProcessorPipeline.from_pretrained(directory, config_filename="policy_preprocessor.json")
    after = PolicyProcessorPipeline.from_pretrained(
        directory,
        config_filename="policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    world, frames = environment_class(environment)(), []
    for seed in range(SEED, SEED + WINDOWS):
        world.reset(seed)
        frames.append(world.observe())
        world.step(np.random.default_rng(seed).uniform(100, 400, 2))
        frames.append(world.observe())
    windows: dict[str, Any] = {
        key: np.stack([f[key] for f in frames]).reshape(WINDOWS, 2, *frames[0][key].shape) for key in frames[0]
    }
    batch = before({**{key: torch.from_numpy(value) for key, value in windows.items()}, "task": [TASK]})
    batch = {
        key: value.expand(WINDOWS, -1) if "language" in key else value
        for key, value in batch.items()
        if "observation." in key
    }
    with torch.no_grad():
        torch.manual_seed(SEED)
        action = after(policy._generate_actions(policy._prepare_batch(batch)))
    torch.manual_seed(SEED)
    noise = torch.randn(WINDOWS, policy.config.horizon, action.shape[-1])  # the only draw, and the first
    np.savez_compressed(out, noise=noise.numpy(), action=action.numpy(), **windows)


if __name__ == "__main__":
    main()
