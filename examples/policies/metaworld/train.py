"""Train one policy for all tasks with the original code of Diffusion Policy, which is not part of this project.

    train.py --original DIFFUSION_POLICY --demonstrations demonstrations.npz -o FOLDER

The network, policy, normaliser, moving average, learning rate and form of the checkpoint are the original's, taken from a
checkout of github.com/real-stanford/diffusion_policy; its published Push-T configuration is changed where ``OVERRIDES``
says. The loop is written anew: the original's wants wandb and one of its own simulators. Products of matrices take a CPU
half the time in bfloat16, so a copy of the network in bfloat16 gives the gradients of the weights, which are float32.
"""

from __future__ import annotations

import argparse
import copy
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from environment import OBSERVATION

HORIZON, WINDOW, EXECUTED = 8, 2, 6


def configuration(original: Path, seed: int, steps: int) -> Any:
    """The original's configuration for Push-T, for these tasks."""
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("eval", eval, replace=True)
    config = OmegaConf.load(
        original / "diffusion_policy/config/train_diffusion_transformer_lowdim_pusht_workspace.yaml"
    )
    for entry in ("defaults", "hydra", "multi_run", "logging", "checkpoint"):
        del config[entry]
    task = {"name": "metaworld_lowdim", "obs_dim": OBSERVATION, "action_dim": 4}
    overrides = {
        "task": task,
        "task_name": task["name"],
        "horizon": HORIZON,
        "n_action_steps": EXECUTED,
        "policy": {"model": {"n_layer": 6, "n_head": 4, "n_emb": 128, "p_drop_attn": 0.0}},
        "dataloader": {"batch_size": 64},
        "optimizer": {"learning_rate": 1e-3, "weight_decay": 1e-3},
        "training": {"device": "cpu", "seed": seed, "lr_warmup_steps": 300, "num_epochs": 1, "max_train_steps": steps},
    }
    merged = OmegaConf.merge(config, overrides)
    OmegaConf.resolve(merged)
    return merged


def windows(demonstrations: Path) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Observations ``[F, 42]``, actions ``[F, 4]`` and ``[N, 8]`` numbers of frames, a row a training example.

    As the original cuts them, the first and the last frame of an episode are repeated. Left out are those where a push
    falls into the actions that are executed.
    """
    with np.load(demonstrations) as file:
        obs, action, pushed, ends = (file[name] for name in ("obs", "action", "pushed", "episode_ends"))
    rows = []
    for first, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        starts = np.arange(first - (WINDOW - 1), end - HORIZON + EXECUTED)
        rows.append(np.clip(starts[:, None] + np.arange(HORIZON), first, end - 1))
    index = np.concatenate(rows)
    executed = slice(WINDOW - 1, WINDOW - 1 + EXECUTED)
    return torch.from_numpy(obs), torch.from_numpy(action), index[~pushed[index[:, executed]].any(axis=1)]


def in_bfloat16(policy: Any) -> Any:
    """A copy of the policy whose network computes in bfloat16, and takes and gives float32."""
    faster = copy.deepcopy(policy)
    network = faster.model.to(torch.bfloat16)
    network.time_emb.register_forward_hook(lambda module, given, result: result.to(torch.bfloat16))
    network.register_forward_pre_hook(lambda module, given: (given[0].bfloat16(), given[1], given[2].bfloat16()))
    network.register_forward_hook(lambda module, given, result: result.float())
    return faster


def main() -> None:
    """Train and write the checkpoints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--original", type=Path, required=True, help="checkout of the original")
    parser.add_argument("--demonstrations", type=Path, required=True)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--save-every", type=int, default=1_000, help="steps")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    sys.path.insert(0, str(arguments.original))

    import typing

    import diffusers.optimization
    import dill
    import hydra

    for name in ("Union", "Optional"):  # the original takes them from there; today's diffusers no longer has them
        setattr(diffusers.optimization, name, getattr(typing, name))
    from diffusion_policy.model.common.lr_scheduler import get_scheduler
    from diffusion_policy.model.common.normalizer import LinearNormalizer
    from diffusion_policy.workspace.base_workspace import BaseWorkspace

    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    config = configuration(arguments.original, arguments.seed, arguments.steps)
    workspace = BaseWorkspace(config, output_dir=str(arguments.output))
    workspace.include_keys = ("global_step", "epoch")
    workspace.model = hydra.utils.instantiate(config.policy)
    obs, action, index = windows(arguments.demonstrations)
    normalizer = LinearNormalizer()
    normalizer.fit({"obs": obs, "action": action}, mode="limits")
    workspace.model.set_normalizer(normalizer)
    workspace.ema_model = copy.deepcopy(workspace.model)
    workspace.optimizer = workspace.model.get_optimizer(**config.optimizer)
    workspace.global_step, workspace.epoch = 0, 0
    average = hydra.utils.instantiate(config.ema, model=workspace.ema_model)
    rate = get_scheduler(
        config.training.lr_scheduler, workspace.optimizer, config.training.lr_warmup_steps, arguments.steps
    )
    faster = in_bfloat16(workspace.model)
    pairs = list(zip(workspace.model.model.parameters(), faster.model.parameters(), strict=True))
    print(f"{len(index)} windows, {sum(weight.numel() for weight in workspace.model.parameters())} weights", flush=True)

    (arguments.output / "checkpoints").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(arguments.seed)
    started, losses = time.monotonic(), []
    while workspace.global_step < arguments.steps:
        chosen = torch.from_numpy(index[rng.integers(len(index), size=config.dataloader.batch_size)])
        loss = faster.compute_loss({"obs": obs[chosen], "action": action[chosen]})
        loss.backward()
        for weight, fast in pairs:
            weight.grad, fast.grad = (None if fast.grad is None else fast.grad.float()), None
        torch.nn.utils.clip_grad_norm_(workspace.model.parameters(), 1.0)
        workspace.optimizer.step()
        with torch.no_grad():
            for weight, fast in pairs:
                fast.copy_(weight)
        rate.step()
        average.step(workspace.model)
        workspace.global_step += 1
        losses.append(loss.item())
        if workspace.global_step % 100 == 0:
            pace = (time.monotonic() - started) / workspace.global_step
            print(f"step {workspace.global_step} loss {np.mean(losses[-100:]):.4f} {pace:.3f} s a step", flush=True)
        if workspace.global_step % arguments.save_every == 0 or workspace.global_step == arguments.steps:
            latest = Path(workspace.save_checkpoint(use_thread=False))
            payload = torch.load(latest, pickle_module=dill, map_location="cpu", weights_only=False)
            weights = payload["state_dicts"]["ema_model"]
            halves = {name: value if name.startswith("normalizer") else value.half() for name, value in weights.items()}
            payload["state_dicts"] = {"ema_model": halves}
            small = arguments.output / f"metaworld_dpt_ema_fp16_{workspace.global_step}.ckpt"
            torch.save(payload, small, pickle_module=dill)


if __name__ == "__main__":
    main()
