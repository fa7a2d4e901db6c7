"""Train Diffusion Policy's U-Net for Push-T from keypoints with its original code, in widths that a CPU can train.

    python examples/policies/unet/train.py DIFFUSION_POLICY --demonstrations pusht_demonstrations.npz -o FOLDER

DIFFUSION_POLICY is a checkout of github.com/real-stanford/diffusion_policy. What its code does, and what is written
anew, is in ``../diffusion_policy_training.py``. The demonstrations are those published with Diffusion Policy: ``state
[F, 5]``, ``action [F, 2]`` and ``episode_ends [E]``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from diffusion_policy_training import configuration, cut, find_original, in_bfloat16, recipe_options, train  # noqa: E402
from environments.pusht import observation  # noqa: E402

HORIZON, WINDOW, EXECUTED = 16, 2, 8
"""T, To and Ta, as published."""


def windows(ends: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Numbers of the frames of each training example, an episode's first and last frame repeated as the original does.

    Args:
        ends: ``[E]``, number of frames up to the end of each episode.

    Returns:
        ``[N, HORIZON]``.
    """
    return cut(ends, HORIZON, WINDOW - 1, EXECUTED - 1)


@click.command()
@recipe_options(steps=10000, save_every=2000)
def main(original: Path, demonstrations: Path, steps: int, seed: int, **run: Any) -> None:
    """Train on one thread, and write checkpoints into a folder."""
    import hydra

    find_original(original)
    changes = {
        "task": {"name": "pusht_lowdim", "obs_dim": 20, "action_dim": 2, "keypoint_dim": 2},
        "policy": {"model": {"diffusion_step_embed_dim": 128, "down_dims": [64, 128, 256]}},
        "dataloader": {"batch_size": 128},
        "optimizer": {"lr": 5e-4},
    }
    name = "train_diffusion_unet_lowdim_workspace.yaml"
    config = configuration(original, name, changes, seed, steps)
    with np.load(demonstrations) as file:
        obs = torch.from_numpy(observation(file["state"]))
        action = torch.from_numpy(file["action"].astype(np.float32))
        frames = windows(file["episode_ends"])
    train(
        config,
        obs,
        action,
        frames,
        "pusht_unet",
        optimizer=lambda policy: hydra.utils.instantiate(config.optimizer, params=policy.model.parameters()),
        make_step=in_bfloat16(lambda network: network.diffusion_step_encoder[0]),
        steps=steps,
        seed=seed,
        **run,
    )


if __name__ == "__main__":
    main()
