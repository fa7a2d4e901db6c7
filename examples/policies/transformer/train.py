"""Train Diffusion Policy's transformer for Push-T from keypoints, at its published size, with its original code.

    python examples/policies/transformer/train.py DIFFUSION_POLICY --demonstrations pusht_demonstrations.npz -o FOLDER

DIFFUSION_POLICY is a checkout of github.com/real-stanford/diffusion_policy. What its code does, and what is written
anew, is in ``../diffusion_policy_training.py``. The demonstrations are those of ``../unet/train.py``. The configuration
is the published one, but for the learning rate, what is dropped from attention, and all 206 episodes in place of 90.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch.nn.functional import mse_loss

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from diffusion_policy_training import captured, configuration, cut, find_original, in_bfloat16, recipe_options, train  # noqa: E402
from environments.pusht import observation  # noqa: E402

HORIZON, WINDOW, EXECUTED = 16, 2, 8
"""T, To and Ta, as published."""


def loss_of(policy: Any, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """The original's ``compute_loss``, where no part of the actions is given, with the same random numbers."""
    scaled = policy.normalizer.normalize({"obs": obs, "action": action})
    noise = torch.randn(action.shape, device=action.device)
    timesteps = torch.randint(0, policy.num_inference_steps, (len(action),), device=action.device)
    noisy = policy.noise_scheduler.add_noise(scaled["action"], noise, timesteps)
    return mse_loss(policy.model(noisy, timesteps, scaled["obs"][:, : policy.n_obs_steps]), noise)


class DropBytes(torch.nn.Dropout):
    """Dropout whose mask is of random bytes. A CPU draws torch's in a third of a step, and these in a twentieth.

    The probability is a whole number of 256ths.
    """

    rng = np.random.Generator(np.random.SFC64(0))

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """The input, with some of its values replaced by 0 and the others made as much larger."""
        left_out = round(256 * self.p)
        drawn = torch.from_numpy(self.rng.integers(256, size=tuple(input.shape), dtype=np.uint8))
        return input * ((drawn >= left_out).to(input.dtype) * (256 / (256 - left_out)))


def on_a_cpu(network: Any) -> Any:
    """The network's module of the time, once dropout is quick, and attention is two products without a dropout."""
    torch.backends.cuda.enable_flash_sdp(False)  # of the CPU, too, whose backward takes a third of a step
    for module in list(network.modules()):
        if isinstance(module, torch.nn.MultiheadAttention):
            module.dropout = 0.0
        for name, child in module.named_children():
            if isinstance(child, torch.nn.Dropout):
                setattr(module, name, DropBytes(child.p))
    return network.time_emb


@click.command()
@recipe_options(steps=60000, save_every=10000)
@click.option("--device", default="cuda", show_default=True, help="A GPU, as torch calls it, or cpu.")
@click.option("--start", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Checkpoint to begin with.")
@click.option("--learning-rate", default=3e-4, show_default=True, type=click.FloatRange(0, min_open=True))
@click.option(
    "--dropout",
    default=0.1,
    show_default=True,
    type=click.FloatRange(0, 1),
    help="Of layers; and of attention, on a GPU.",
)
def main(
    original: Path,
    demonstrations: Path,
    steps: int,
    seed: int,
    device: str,
    learning_rate: float,
    dropout: float,
    **run: Any,
) -> None:
    """Train, and write checkpoints into a folder."""
    if device != "cpu" and not torch.cuda.is_available():
        raise click.ClickException(
            "torch finds no GPU here. Give --device cpu, which takes hours where it has bfloat16."
        )
    find_original(original)
    changes = {
        "task": {"name": "pusht_lowdim", "obs_dim": 20, "action_dim": 2, "keypoint_dim": 2},
        "policy": {"model": {"p_drop_attn": dropout}},
        "optimizer": {"learning_rate": learning_rate},
    }
    name = "train_diffusion_transformer_lowdim_pusht_workspace.yaml"
    config = configuration(original, name, changes, seed, steps)
    config.training.device = device
    with np.load(demonstrations) as file:
        obs = torch.from_numpy(observation(file["state"]))
        action = torch.from_numpy(file["action"].astype(np.float32))
        frames = cut(file["episode_ends"], HORIZON, WINDOW - 1, EXECUTED - 1)
    train(
        config,
        obs,
        action,
        frames,
        "pusht_transformer",
        optimizer=lambda policy: policy.get_optimizer(**config.optimizer),
        make_step=in_bfloat16(on_a_cpu) if device == "cpu" else captured(loss_of),
        steps=steps,
        seed=seed,
        **run,
    )


if __name__ == "__main__":
    main()
