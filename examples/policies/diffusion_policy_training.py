"""What the recipes of Diffusion Policy's networks share: the original's code, found and set up, and the training loop.

Network, policy, normaliser, optimiser, learning rate, moving average and the form of the checkpoint are the original's
own (a checkout of github.com/real-stanford/diffusion_policy, which is not part of this project), and so is the
configuration, except for what a recipe changes. The loop is written anew, since the original's needs an account at
wandb and its own simulators. A CPU multiplies matrices in half the time in bfloat16: a copy of the network in bfloat16
gives the gradients, and the weights are float32.
"""

from __future__ import annotations

import copy
import sys
import time
import typing
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch

TOLD_EVERY = 100
"""Steps between lines of progress."""


def find_original(original: Path) -> None:
    """Make the original's modules importable.

    Args:
        original: Its checkout.
    """
    import diffusers.optimization

    sys.path.insert(0, str(original))
    for name in ("Union", "Optional"):  # the original imports them from there; today's diffusers has them no longer
        setattr(diffusers.optimization, name, getattr(typing, name))


def recipe_options(steps: int, save_every: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """What every recipe is given on the command line, with these defaults."""
    options = (
        click.argument("original", type=click.Path(exists=True, file_okay=False, path_type=Path)),
        click.option("--demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path), required=True),
        click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True),
        click.option("--steps", default=steps, show_default=True, type=click.IntRange(1)),
        click.option("--save-every", default=save_every, show_default=True, type=click.IntRange(1), help="Steps."),
        click.option("--seed", default=0, show_default=True),
        click.option("--resume", is_flag=True, help="Go on from the last checkpoint in the folder."),
    )
    return lambda command: reduce(lambda made, option: option(made), reversed(options), command)


def cut(ends: npt.NDArray[np.int64], horizon: int, before: int, after: int) -> npt.NDArray[np.int64]:
    """Numbers of the frames of each training example, cut within an episode as the original cuts them.

    Args:
        ends: ``[E]``, number of frames up to the end of each episode.
        horizon: T, the frames of an example.
        before: How often at most an episode's first frame is repeated.
        after: The same of its last frame.

    Returns:
        ``[N, T]``.
    """
    rows = []
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        starts = np.arange(first - before, end - horizon + after + 1)
        rows.append(np.clip(starts[:, None] + np.arange(horizon), first, end - 1))
    return np.concatenate(rows)


def configuration(original: Path, name: str, changes: dict[str, Any], seed: int, steps: int) -> Any:
    """One of the original's configurations, changed and resolved.

    Args:
        original: The original's checkout.
        name: The configuration's file.
        changes: Entries that the recipe sets.
        seed: Of weights, examples and noise.
        steps: Of the training.
    """
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("eval", eval, replace=True)  # as the original does
    config = OmegaConf.load(original / "diffusion_policy" / "config" / name)
    for entry in ("defaults", "hydra", "multi_run", "logging", "checkpoint"):
        config.pop(entry, None)
    training = {"device": "cpu", "seed": seed, "lr_warmup_steps": 300, "num_epochs": 1, "max_train_steps": steps}
    merged = OmegaConf.merge(config, {**changes, "training": training})
    OmegaConf.resolve(merged)
    return merged


def in_bfloat16(policy: Any, time_embedding: Callable[[Any], Any]) -> Any:
    """A copy of the policy whose network computes in bfloat16, and takes and gives float32.

    Args:
        policy: The original's policy.
        time_embedding: Gives the network's module that turns timesteps into float32 numbers.
    """
    faster = copy.deepcopy(policy)
    network = faster.model.to(torch.bfloat16)

    def halve(given: Any) -> Any:
        return given.bfloat16() if torch.is_tensor(given) and given.is_floating_point() else given

    time_embedding(network).register_forward_hook(lambda module, given, result: result.bfloat16())
    network.register_forward_pre_hook(
        lambda module, given, named: (tuple(map(halve, given)), {name: halve(value) for name, value in named.items()}),
        with_kwargs=True,
    )
    network.register_forward_hook(lambda module, given, result: result.float())
    return faster


def save(workspace: Any, folder: Path, name: str) -> None:
    """Write the checkpoint as the original writes it, and its moving average alone in half precision."""
    import dill

    whole = Path(workspace.save_checkpoint(use_thread=False))
    payload = torch.load(whole, pickle_module=dill, map_location="cpu", weights_only=False)
    weights = payload["state_dicts"]["ema_model"]
    halves = {name: value if name.startswith("normalizer") else value.half() for name, value in weights.items()}
    payload["state_dicts"] = {"ema_model": halves}
    torch.save(payload, folder / f"{name}_ema_fp16_{workspace.global_step}.ckpt", pickle_module=dill)


def train(  # noqa: PLR0915  # the recipe, line by line
    config: Any,
    obs: torch.Tensor,
    action: torch.Tensor,
    frames: npt.NDArray[np.int64],
    name: str,
    *,
    output: Path,
    optimizer: Callable[[Any], torch.optim.Optimizer],
    time_embedding: Callable[[Any], Any],
    steps: int,
    save_every: int,
    seed: int,
    resume: bool,
) -> None:
    """Train on one thread, and write checkpoints into a folder.

    Args:
        config: The original's configuration, of ``configuration``.
        obs: ``[F, Do]``, the frames' observations.
        action: ``[F, Da]``, their actions.
        frames: ``[N, T]``, the frames of each example.
        name: What the small checkpoints' names begin with.
        output: The folder.
        optimizer: Makes the optimiser of a policy.
        time_embedding: Gives the network's module that turns timesteps into numbers.
        steps: Steps in all, those before ``resume`` included.
        save_every: Steps between checkpoints.
        seed: Of weights, examples and noise.
        resume: Go on from the last checkpoint in the folder.
    """
    import hydra
    from diffusion_policy.model.common.lr_scheduler import get_scheduler
    from diffusion_policy.model.common.normalizer import LinearNormalizer
    from diffusion_policy.workspace.base_workspace import BaseWorkspace

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    workspace = BaseWorkspace(config, output_dir=str(output))
    workspace.include_keys = ("global_step", "epoch")
    workspace.model = hydra.utils.instantiate(config.policy)
    normalizer = LinearNormalizer()
    normalizer.fit({"obs": obs, "action": action}, mode="limits")
    workspace.model.set_normalizer(normalizer)
    workspace.ema_model = copy.deepcopy(workspace.model)
    workspace.optimizer = optimizer(workspace.model)
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
    faster = in_bfloat16(workspace.model, time_embedding)
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
            save(workspace, output, name)
