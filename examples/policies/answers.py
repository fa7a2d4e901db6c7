"""What lerobot itself answers with a saved policy, for the tests: its observations, its noise, its executed actions.

    python examples/policies/answers.py flow/policy build/policies/flow -o flow/answers.npz
    python examples/policies/answers.py so101/policy . -o so101/answers.npz --environment so101

lerobot is run from the folder that has the whole encoder (``train.py``'s ``--out``): the saved policy has only its
configuration. One without an encoder is run anywhere.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

sys.path[1:1] = [str(Path(__file__).parents[1] / "evaluation")]

from environments import environment_class, environment_option  # noqa: E402
from multi_task_dit import ENCODER, TASK  # noqa: E402

WINDOWS, SEED = 4, 200_000


@click.command()
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(dir_okay=False, path_type=Path))
@environment_option
def main(directory: Path, folder: Path, out: Path, environment: str) -> None:
    """Write windows ``[N, 2, ...]`` by key, ``noise [N, T, D]`` and ``action [N, Ta, D]``.

    Of a policy whose sampler draws at its steps, ``steps [K, N, T, D]``, too.
    """
    directory, out = directory.resolve(), out.resolve()
    os.chdir(folder)
    torch.manual_seed(SEED)
    policy: Any = get_policy_class(PreTrainedConfig.from_pretrained(directory).type).from_pretrained(directory).eval()
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
        rest, rng = world.rest(), np.random.default_rng(seed)
        world.step(rng.uniform(100, 400, 2) if "pusht" in environment else rest + rng.uniform(0, 1, rest.shape))
        frames.append(world.observe())
    windows: dict[str, Any] = {
        key: np.stack([f[key] for f in frames]).reshape(WINDOWS, 2, *frames[0][key].shape) for key in frames[0]
    }
    tokens = {"task": [TASK]} if directory.joinpath(ENCODER).exists() else {}
    batch = before({**{key: torch.from_numpy(value) for key, value in windows.items()}, **tokens})
    batch = {
        key: value.expand(WINDOWS, -1) if "language" in key else value
        for key, value in batch.items()
        if "observation." in key
    }
    diffuses = policy.config.type == "diffusion"
    with torch.no_grad():
        torch.manual_seed(SEED)
        prepared = batch if diffuses else policy._prepare_batch(batch)
        action = after((policy.diffusion.generate_actions if diffuses else policy._generate_actions)(prepared))
    torch.manual_seed(SEED)
    shape = (WINDOWS, policy.config.horizon, action.shape[-1])
    noise: dict[str, Any] = {"noise": torch.randn(shape).numpy()}  # the only draw, and the first
    if diffuses:
        count = policy.config.num_train_timesteps
        noise["steps"] = np.stack(
            [*(torch.randn(shape).numpy() for _ in range(count - 1)), np.zeros(shape, np.float32)]
        )
    np.savez_compressed(out, **noise, action=action.numpy(), **windows)


if __name__ == "__main__":
    main()
