"""Train one policy for all tasks of Meta-World with the original code of Diffusion Policy.

    python examples/policies/metaworld/train.py DIFFUSION_POLICY --demonstrations demonstrations.npz -o FOLDER

DIFFUSION_POLICY is a checkout of github.com/real-stanford/diffusion_policy, which is not part of this project. Network,
policy, normaliser, optimiser, learning rate, moving average and the form of the checkpoint are its own, and so is the
configuration, that of Push-T, except for what ``configuration`` changes. The loop is written anew, since the original's
needs an account at wandb and one of its own simulators. A CPU multiplies matrices in half the time in bfloat16: a copy
of the network in bfloat16 gives the gradients, and the weights are float32.
"""

from __future__ import annotations

import copy
import sys
import time
import typing
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch

HORIZON, WINDOW, EXECUTED = 8, 2, 4
"""T, To and Ta."""
UNDISTURBED = 6
"""Actions of an example that no push may fall into."""
TOLD_EVERY = 100
"""Steps between lines of progress."""


def configuration(original: Path, obs_dim: int, action_dim: int, seed: int, steps: int) -> Any:
    """The original's configuration for Push-T, changed for these tasks and a short training on a CPU."""
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("eval", eval, replace=True)  # as the original does
    name = "train_diffusion_transformer_lowdim_pusht_workspace.yaml"
    config = OmegaConf.load(original / "diffusion_policy" / "config" / name)
    for entry in ("defaults", "hydra", "multi_run", "logging", "checkpoint"):
        del config[entry]
    changes = {
        "task": {"name": "metaworld_lowdim", "obs_dim": obs_dim, "action_dim": action_dim},
        "horizon": HORIZON,
        "n_action_steps": EXECUTED,
        "policy": {"model": {"n_layer": 6, "n_head": 4, "n_emb": 128, "p_drop_attn": 0.0}},
        "dataloader": {"batch_size": 64},
        "optimizer": {"learning_rate": 1e-3, "weight_decay": 1e-3},
        "training": {"device": "cpu", "seed": seed, "lr_warmup_steps": 300, "num_epochs": 1, "max_train_steps": steps},
    }
    merged = OmegaConf.merge(config, changes)
    OmegaConf.resolve(merged)
    return merged


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


def in_bfloat16(policy: Any) -> Any:
    """A copy of the policy whose network computes in bfloat16, and takes and gives float32."""
    faster = copy.deepcopy(policy)
    network = faster.model.to(torch.bfloat16)
    network.time_emb.register_forward_hook(lambda module, given, result: result.bfloat16())
    network.register_forward_pre_hook(lambda module, given: (given[0].bfloat16(), given[1], given[2].bfloat16()))
    network.register_forward_hook(lambda module, given, result: result.float())
    return faster


def save(workspace: Any, folder: Path) -> None:
    """The checkpoint as the original writes it, and its moving average alone in half precision."""
    import dill

    whole = Path(workspace.save_checkpoint(use_thread=False))
    payload = torch.load(whole, pickle_module=dill, map_location="cpu", weights_only=False)
    weights = payload["state_dicts"]["ema_model"]
    halves = {name: value if name.startswith("normalizer") else value.half() for name, value in weights.items()}
    payload["state_dicts"] = {"ema_model": halves}
    torch.save(payload, folder / f"metaworld_dpt_ema_fp16_{workspace.global_step}.ckpt", pickle_module=dill)


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
    import diffusers.optimization
    import hydra

    sys.path.insert(0, str(original))
    for name in ("Union", "Optional"):  # the original imports them from there; today's diffusers has them no longer
        setattr(diffusers.optimization, name, getattr(typing, name))
    from diffusion_policy.model.common.lr_scheduler import get_scheduler
    from diffusion_policy.model.common.normalizer import LinearNormalizer
    from diffusion_policy.workspace.base_workspace import BaseWorkspace

    torch.set_num_threads(1)
    with np.load(demonstrations) as file:
        obs, action = (torch.from_numpy(file[name]) for name in ("obs", "action"))
        frames = windows(file["pushed"], file["episode_ends"])
    config = configuration(original, obs.shape[1], action.shape[1], seed, steps)

    torch.manual_seed(seed)
    workspace = BaseWorkspace(config, output_dir=str(output))
    workspace.include_keys = ("global_step", "epoch")
    workspace.model = hydra.utils.instantiate(config.policy)
    normalizer = LinearNormalizer()
    normalizer.fit({"obs": obs, "action": action}, mode="limits")
    workspace.model.set_normalizer(normalizer)
    workspace.ema_model = copy.deepcopy(workspace.model)
    workspace.optimizer = workspace.model.get_optimizer(**config.optimizer)
    workspace.global_step = workspace.epoch = 0
    if resume:
        workspace.load_checkpoint(weights_only=False)
    average = hydra.utils.instantiate(config.ema, model=workspace.ema_model)
    average.optimization_step = workspace.global_step
    rate = get_scheduler(
        config.training.lr_scheduler,
        workspace.optimizer,
        num_warmup_steps=config.training.lr_warmup_steps,
        num_training_steps=steps,
        last_epoch=workspace.global_step - 1,
    )
    faster = in_bfloat16(workspace.model)
    pairs = list(zip(workspace.model.model.parameters(), faster.model.parameters(), strict=True))
    print(f"{len(frames)} windows, {sum(weight.numel() for weight, _ in pairs)} weights", flush=True)

    (output / "checkpoints").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, workspace.global_step])
    torch.manual_seed(seed + workspace.global_step)
    began, losses = time.monotonic(), []
    while workspace.global_step < steps:
        chosen = torch.from_numpy(rng.choice(frames, config.dataloader.batch_size))
        loss = faster.compute_loss({"obs": obs[chosen], "action": action[chosen]})
        loss.backward()
        for weight, fast in pairs:
            weight.grad, fast.grad = (None if fast.grad is None else fast.grad.float()), None
        torch.nn.utils.clip_grad_norm_(workspace.model.parameters(), 1.0)
        workspace.optimizer.step()
        rate.step()
        average.step(workspace.model)
        with torch.no_grad():
            for weight, fast in pairs:
                fast.copy_(weight)
        workspace.global_step += 1
        losses.append(loss.item())
        if workspace.global_step % TOLD_EVERY == 0:
            taken = time.monotonic() - began
            print(f"step {workspace.global_step}: loss {np.mean(losses[-TOLD_EVERY:]):.4f}, {taken:.0f} s", flush=True)
        if workspace.global_step % save_every == 0 or workspace.global_step == steps:
            save(workspace, output)


if __name__ == "__main__":
    main()
