"""Train one policy for all tasks of Meta-World with the original code of Diffusion Policy.

    python examples/policies/metaworld/train.py DIFFUSION_POLICY --demonstrations demonstrations.npz -o FOLDER

DIFFUSION_POLICY is a checkout of github.com/real-stanford/diffusion_policy. What its code does, and what is written
anew, is in ``../diffusion_policy_training.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch

sys.path[1:1] = [str(Path(__file__).parents[1])]

from diffusion_policy_training import configuration, find_original, train  # noqa: E402

HORIZON, WINDOW, EXECUTED = 8, 2, 4
"""T, To and Ta."""
UNDISTURBED = 6
"""Actions of an example that no push may fall into."""


def windows(pushed: npt.NDArray[Any], ends: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Numbers of the frames of each training example.

    As the original cuts them, an episode's first and last frame are repeated. Examples are left out where a push falls
    into the first ``UNDISTURBED`` actions from the observation on.

    Args:
        pushed: ``[F]``, not zero at steps at which the hand was pushed.
        ends: ``[E]``, number of frames up to the end of each episode.

    Returns:
        ``[N, HORIZON]``.
    """
    rows = []
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        starts = np.arange(first - (WINDOW - 1), end - HORIZON + UNDISTURBED)
        rows.append(np.clip(starts[:, None] + np.arange(HORIZON), first, end - 1))
    frames = np.concatenate(rows)
    undisturbed = frames[:, WINDOW - 1 : WINDOW - 1 + UNDISTURBED]
    return np.asarray(frames[(pushed[undisturbed] == 0).all(axis=1)])


@click.command()
@click.argument("original", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path), required=True)
@click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True)
@click.option("--steps", default=8000, show_default=True, type=click.IntRange(1))
@click.option("--save-every", default=1000, show_default=True, type=click.IntRange(1), help="Steps.")
@click.option("--seed", default=0, show_default=True)
@click.option("--resume", is_flag=True, help="Go on from the last checkpoint in the folder.")
def main(
    original: Path, demonstrations: Path, output: Path, steps: int, save_every: int, seed: int, resume: bool
) -> None:
    """Train on one thread, and write checkpoints into a folder."""
    find_original(original)
    with np.load(demonstrations) as file:
        obs, action = (torch.from_numpy(file[name]) for name in ("obs", "action"))
        frames = windows(file["pushed"], file["episode_ends"])
    changes = {
        "task": {"name": "metaworld_lowdim", "obs_dim": obs.shape[1], "action_dim": action.shape[1]},
        "horizon": HORIZON,
        "n_action_steps": EXECUTED,
        "policy": {"model": {"n_layer": 6, "n_head": 4, "n_emb": 128, "p_drop_attn": 0.0}},
        "dataloader": {"batch_size": 64},
        "optimizer": {"learning_rate": 1e-3, "weight_decay": 1e-3},
        "training": {"device": "cpu", "seed": seed, "lr_warmup_steps": 300, "num_epochs": 1, "max_train_steps": steps},
    }
    name = "train_diffusion_transformer_lowdim_pusht_workspace.yaml"
    config = configuration(original, name, changes)
    train(
        config,
        obs,
        action,
        frames,
        output,
        "metaworld_dpt",
        optimizer=lambda policy: policy.get_optimizer(**config.optimizer),
        time_embedding=lambda network: network.time_emb,
        steps=steps,
        save_every=save_every,
        seed=seed,
        resume=resume,
    )


if __name__ == "__main__":
    main()
