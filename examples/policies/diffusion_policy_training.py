"""What the recipes of Diffusion Policy's networks share: the original's code, found and set up, and the training loop.

Network, policy, normaliser, optimiser, learning rate, moving average and the form of the checkpoint are the original's
own (a checkout of github.com/real-stanford/diffusion_policy, which is not part of this project), and so is the
configuration, except for what a recipe changes. The loop is written anew, since the original's needs an account at
wandb and its own simulators. A CPU multiplies matrices in half the time in bfloat16: a copy of the network in bfloat16
gives the gradients, and the weights are float32. On a GPU a step is one CUDA graph: launching its
thousand small kernels takes longer than they do.
"""

from __future__ import annotations

import copy
import sys
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch

TOLD_EVERY = 100
"""Steps between lines of progress."""
WARMED_UP = 3
"""Steps before a graph is captured, which make what is made once."""


@dataclass(frozen=True)
class Training:
    """What a step of a training changes, and the examples that it draws from.

    Attributes:
        workspace: The original's, with ``model``, ``ema_model`` and ``optimizer``.
        average: The original's, of ``ema_model``.
        obs: ``[F, Do]``, the frames' observations.
        action: ``[F, Da]``, their actions.
        frames: ``[N, T]``, the frames of each example.
        batch: Examples of a step.
        seed: Of those that are drawn.
    """

    workspace: Any
    average: Any
    obs: torch.Tensor
    action: torch.Tensor
    frames: torch.Tensor
    batch: int
    seed: list[int]


MakeStep = Callable[[Training], Callable[[], torch.Tensor]]
"""Makes what takes one step, and gives its loss. The original's scheduler changes the learning rate between steps."""


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
        click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Of a CPU."),
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


def in_bfloat16(time_embedding: Callable[[Any], Any]) -> MakeStep:
    """Steps on a CPU, whose gradients are of a copy of the network in bfloat16.

    Args:
        time_embedding: Gives the network's module that turns timesteps into float32 numbers.
    """

    def make(training: Training) -> Callable[[], torch.Tensor]:
        policy = training.workspace.model
        faster = copy.deepcopy(policy)
        network = faster.model.to(torch.bfloat16)
        time_embedding(network).register_forward_hook(lambda module, given, result: result.bfloat16())
        network.register_forward_pre_hook(
            lambda module, given, named: (tuple(map(_half, given)), {name: _half(one) for name, one in named.items()}),
            with_kwargs=True,
        )
        network.register_forward_hook(lambda module, given, result: result.float())
        pairs = list(zip(policy.model.parameters(), network.parameters(), strict=True))
        rng = np.random.default_rng(training.seed)

        def step() -> torch.Tensor:
            chosen = training.frames[rng.integers(len(training.frames), size=training.batch)]
            loss: torch.Tensor = faster.compute_loss({"obs": training.obs[chosen], "action": training.action[chosen]})
            loss.backward()
            for weight, fast in pairs:
                weight.grad, fast.grad = (None if fast.grad is None else fast.grad.float()), None
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            training.workspace.optimizer.step()
            training.average.step(policy)
            with torch.no_grad():
                for weight, fast in pairs:
                    fast.copy_(weight)
            return loss.detach()

        return step

    return make


def _half(given: Any) -> Any:
    return given.bfloat16() if torch.is_tensor(given) and given.is_floating_point() else given


def _as_told(mask: torch.Tensor | None, is_causal: bool | None = None, size: int | None = None) -> bool:
    """Whether a mask is causal. Torch's decoder would look into the mask, and wait for the GPU, which no graph can."""
    return bool(is_causal)


def captured(loss_of: Callable[[Any, torch.Tensor, torch.Tensor], torch.Tensor]) -> MakeStep:
    """Steps on a GPU, each a CUDA graph with its examples, noise, gradients and optimiser; products are in TF32.

    Args:
        loss_of: The loss of a policy on observations ``[N, T, Do]`` and actions ``[N, T, Da]``, as its
            ``compute_loss``, which selects by a mask: that cannot be captured.
    """

    def make(training: Training) -> Callable[[], torch.Tensor]:
        torch.backends.cuda.matmul.allow_tf32 = True
        torch.nn.modules.transformer._detect_is_causal_mask = _as_told
        policy, optimizer = training.workspace.model, training.workspace.optimizer
        policy.noise_scheduler.alphas_cumprod = policy.noise_scheduler.alphas_cumprod.to(training.obs.device)
        trained = [weight for weight in policy.parameters() if weight.requires_grad]
        averaged = [
            mean
            for mean, weight in zip(training.workspace.ema_model.parameters(), policy.parameters(), strict=True)
            if weight.requires_grad
        ]

        def eager() -> torch.Tensor:
            optimizer.zero_grad(set_to_none=True)
            rows = torch.randint(len(training.frames), (training.batch,), device=training.frames.device)
            chosen = training.frames[rows]
            loss = loss_of(policy, training.obs[chosen], training.action[chosen])
            loss.backward()
            torch.nn.utils.clip_grad_norm_(trained, 1.0, foreach=True)
            optimizer.step()
            return loss.detach()

        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARMED_UP):
                eager()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            loss = eager()

        @torch.no_grad()
        def step() -> torch.Tensor:
            graph.replay()
            kept = training.average.get_decay(training.average.optimization_step)
            torch._foreach_lerp_(averaged, trained, 1 - kept)
            training.average.optimization_step += 1
            return loss

        return step

    return make


def averaged(checkpoint: Path) -> dict[str, torch.Tensor]:
    """The moving average of the weights in a checkpoint, in float32."""
    import dill

    payload = torch.load(checkpoint, pickle_module=dill, map_location="cpu", weights_only=False)
    return {name: value.float() for name, value in payload["state_dicts"]["ema_model"].items()}


def save(workspace: Any, folder: Path, name: str) -> None:
    """Write the checkpoint as the original writes it, and its moving average alone in half precision."""
    import dill

    whole = Path(workspace.save_checkpoint(use_thread=False))
    payload = torch.load(whole, pickle_module=dill, map_location="cpu", weights_only=False)
    weights = payload["state_dicts"]["ema_model"]
    halves = {name: value if name.startswith("normalizer") else value.half() for name, value in weights.items()}
    payload["state_dicts"] = {"ema_model": halves}
    torch.save(payload, folder / f"{name}_ema_fp16_{workspace.global_step}.ckpt", pickle_module=dill)


def train(
    config: Any,
    obs: torch.Tensor,
    action: torch.Tensor,
    frames: npt.NDArray[np.int64],
    name: str,
    *,
    output: Path,
    optimizer: Callable[[Any], torch.optim.Optimizer],
    make_step: MakeStep,
    steps: int,
    save_every: int,
    seed: int,
    resume: bool,
    threads: int,
    start: Path | None = None,
) -> None:
    """Train on a CPU or on a GPU, and write checkpoints into a folder.

    Args:
        config: The original's configuration, of ``configuration``.
        obs: ``[F, Do]``, the frames' observations.
        action: ``[F, Da]``, their actions.
        frames: ``[N, T]``, the frames of each example.
        name: What the small checkpoints' names begin with.
        output: The folder.
        optimizer: Makes the optimiser of a policy.
        make_step: Makes a step.
        steps: Steps in all, those before ``resume`` included.
        save_every: Steps between checkpoints.
        seed: Of weights, examples and noise.
        resume: Go on from the last checkpoint in the folder.
        threads: Of a CPU.
        start: A checkpoint whose average of weights the training begins with, in place of random ones.
    """
    import hydra
    from diffusion_policy.model.common.lr_scheduler import get_scheduler
    from diffusion_policy.model.common.normalizer import LinearNormalizer
    from diffusion_policy.workspace.base_workspace import BaseWorkspace

    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    device = config.training.device
    workspace = BaseWorkspace(config, output_dir=str(output))
    workspace.include_keys = ("global_step", "epoch")
    workspace.model = hydra.utils.instantiate(config.policy)
    normalizer = LinearNormalizer()
    normalizer.fit({"obs": obs, "action": action}, mode="limits")
    workspace.model.set_normalizer(normalizer)
    if start is not None:
        workspace.model.load_state_dict(averaged(start))
    workspace.model.to(device)
    workspace.ema_model = copy.deepcopy(workspace.model)
    workspace.optimizer = optimizer(workspace.model)
    for group in workspace.optimizer.param_groups if device != "cpu" else ():  # a graph reads its rate from a tensor
        group.update(capturable=True, lr=torch.tensor(group["lr"], device=device))
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
    examples = (obs.to(device), action.to(device), torch.from_numpy(frames).to(device))
    now = [seed, workspace.global_step]
    torch.manual_seed(sum(now))
    step = make_step(Training(workspace, average, *examples, config.dataloader.batch_size, now))
    weights = sum(weight.numel() for weight in workspace.model.model.parameters())
    print(f"{len(frames)} windows, {weights} weights", flush=True)

    (output / "checkpoints").mkdir(parents=True, exist_ok=True)
    began, losses = time.monotonic(), torch.zeros(TOLD_EVERY, device=device)
    while workspace.global_step < steps:
        losses[workspace.global_step % TOLD_EVERY] = step()
        rate.step()
        workspace.global_step += 1
        if workspace.global_step % TOLD_EVERY == 0:
            taken = time.monotonic() - began
            print(f"step {workspace.global_step}: loss {losses.mean():.4f}, {taken:.0f} s", flush=True)
        if workspace.global_step % save_every == 0 or workspace.global_step == steps:
            save(workspace, output, name)
