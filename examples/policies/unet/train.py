"""Train Diffusion Policy's U-Net for Push-T from keypoints with its original code, in widths that a CPU can train.

    python examples/policies/unet/train.py DIFFUSION_POLICY --demonstrations pusht_demonstrations.npz -o FOLDER

DIFFUSION_POLICY is a checkout of github.com/real-stanford/diffusion_policy. What its code does, and what is written
anew, is in ``../diffusion_policy_training.py``. The demonstrations are those published with Diffusion Policy: ``state
[F, 5]``, ``action [F, 2]`` and ``episode_ends [E]``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
import torch

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from diffusion_policy_training import configuration, find_original, train  # noqa: E402
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
    rows = []
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        starts = np.arange(first - (WINDOW - 1), end - HORIZON + EXECUTED)
        rows.append(np.clip(starts[:, None] + np.arange(HORIZON), first, end - 1))
    return np.concatenate(rows)


@click.command()
@click.argument("original", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path), required=True)
@click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True)
@click.option("--steps", default=10000, show_default=True, type=click.IntRange(1))
@click.option("--save-every", default=2000, show_default=True, type=click.IntRange(1), help="Steps.")
@click.option("--seed", default=0, show_default=True)
@click.option("--resume", is_flag=True, help="Go on from the last checkpoint in the folder.")
def main(
    original: Path, demonstrations: Path, output: Path, steps: int, save_every: int, seed: int, resume: bool
) -> None:
    """Train on one thread, and write checkpoints into a folder."""
    find_original(original)
    changes = {
        "task": {"name": "pusht_lowdim", "obs_dim": 20, "action_dim": 2, "keypoint_dim": 2},
        "policy": {"model": {"diffusion_step_embed_dim": 128, "down_dims": [64, 128, 256]}},
        "dataloader": {"batch_size": 128},
        "optimizer": {"lr": 5e-4},
        "training": {"device": "cpu", "seed": seed, "lr_warmup_steps": 300, "num_epochs": 1, "max_train_steps": steps},
    }
    name = "train_diffusion_unet_lowdim_workspace.yaml"
    config = configuration(original, name, changes)
    with np.load(demonstrations) as file:
        obs = torch.from_numpy(observation(file["state"]))
        action = torch.from_numpy(file["action"].astype(np.float32))
        frames = windows(file["episode_ends"])
    train(
        config,
        obs,
        action,
        frames,
        output,
        "pusht_unet",
        optimizer=lambda policy: torch.optim.AdamW(
            policy.model.parameters(),
            lr=config.optimizer.lr,
            betas=tuple(config.optimizer.betas),
            eps=config.optimizer.eps,
            weight_decay=config.optimizer.weight_decay,
        ),
        time_embedding=lambda network: network.diffusion_step_encoder[0],
        steps=steps,
        save_every=save_every,
        seed=seed,
        resume=resume,
    )


if __name__ == "__main__":
    main()
