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

from diffusion_policy_training import configuration, cut, find_original, in_bfloat16, recipe_options, train  # noqa: E402

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
    frames = cut(ends, HORIZON, WINDOW - 1, UNDISTURBED - 1)
    undisturbed = frames[:, WINDOW - 1 : WINDOW - 1 + UNDISTURBED]
    return np.asarray(frames[(pushed[undisturbed] == 0).all(axis=1)])


@click.command()
@recipe_options(steps=8000, save_every=1000)
def main(original: Path, demonstrations: Path, steps: int, seed: int, **run: Any) -> None:
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
    }
    name = "train_diffusion_transformer_lowdim_pusht_workspace.yaml"
    config = configuration(original, name, changes, seed, steps)
    train(
        config,
        obs,
        action,
        frames,
        "metaworld_dpt",
        optimizer=lambda policy: policy.get_optimizer(**config.optimizer),
        make_step=in_bfloat16(lambda network: network.time_emb),
        steps=steps,
        seed=seed,
        **run,
    )


if __name__ == "__main__":
    main()
