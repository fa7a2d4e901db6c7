"""Train LeRobot's ``diffusion``, a U-Net with 100 steps of DDPM, for an SO-101 arm, with lerobot's own code.

    OMP_NUM_THREADS=1 python examples/policies/so101/train.py demonstrations.npz -o build/policies/so101

The policy observes two frames of the arm, the block and the place, predicts 16 actions and executes eight. Its settings
are lerobot's, but for the widths of the network (lerobot's levels have 512, 1024 and 2048 channels). lerobot has to be
importable; none of its code is here.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch.optim.swa_utils import AveragedModel

STATE, PLACES, ACTION = "observation.state", "observation.environment_state", "action"
WINDOW, HORIZON, EXECUTED = 2, 16, 8
"""Frames that are observed, actions that are predicted and executed."""


def untrained(stats: dict[str, dict[str, torch.Tensor]]) -> tuple[Any, tuple[Any, Any]]:
    """lerobot's policy with a smaller network, and its processors.

    lerobot does not normalise what is observed of the environment unless it is told to.
    """
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors

    some = NormalizationMode.MIN_MAX
    config = DiffusionConfig(
        input_features={STATE: PolicyFeature(FeatureType.STATE, (9,)), PLACES: PolicyFeature(FeatureType.ENV, (6,))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (4,))},
        normalization_mapping={"STATE": some, "ENV": some, "ACTION": some},
        device="cpu",
        push_to_hub=False,
        n_obs_steps=WINDOW,
        horizon=HORIZON,
        n_action_steps=EXECUTED,
        drop_n_last_frames=0,
        down_dims=(64, 128, 256),
        diffusion_step_embed_dim=64,
    )
    return DiffusionPolicy(config), make_diffusion_pre_post_processors(config, stats)


def windows(data: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Every frame as ``now``: the frames up to it, and the actions from the first of them on, as lerobot pads them.

    Windows in whose executed actions a push is felt are left out.
    """
    observed, acted = [], []
    ends = data["episode_ends"]
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        now = np.arange(first, end)[:, None]
        observed.append(np.maximum(now + np.arange(1 - WINDOW, 1), first))
        acted.append(np.clip(now + np.arange(1 - WINDOW, 1 - WINDOW + HORIZON), first, end - 1))
    before, after = np.concatenate(observed), np.concatenate(acted)
    kept = ~data["pushed"].astype(bool)[after[:, WINDOW - 1 : WINDOW - 1 + EXECUTED]].any(1)
    named = ((STATE, "state", before), (PLACES, "places", before), (ACTION, "action", after))
    made = {key: torch.from_numpy(data[name][rows[kept]]) for key, name, rows in named}
    return made | {"action_is_pad": torch.zeros(int(kept.sum()), HORIZON, dtype=torch.bool)}


def draw(count: int, size: int, seed: int) -> Iterator[torch.Tensor]:
    """Rows of batches without end, every epoch in an order of its own."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        yield from torch.randperm(count, generator=generator).split(size)[: count // size]


def statistics(values: np.ndarray) -> dict[str, torch.Tensor]:
    """What lerobot's normalisers want to know of a feature, over ``[N, D]``."""
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {name: torch.as_tensor(value, dtype=torch.float32) for name, value in found.items()}


def average(average: torch.Tensor, now: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
    """Exponential average whose memory grows with the number of steps, up to 1000 of them."""
    return average.lerp(now, max(0.001, (1 + float(count)) ** -0.75))


def save(network: Any, processors: tuple[Any, Any], folder: Path) -> None:
    """The policy as lerobot saves one, its weights in half precision. The folder appears at once."""
    beside = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    for each in (network, *processors):
        each.save_pretrained(beside)
    weights = load_file(beside / "model.safetensors")
    save_file({name: value.half() for name, value in weights.items()}, beside / "model.safetensors", {"format": "pt"})
    shutil.rmtree(folder, ignore_errors=True)
    beside.rename(folder)


@click.command()
@click.argument("demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--steps", default=10000, show_default=True, type=click.IntRange(1))
@click.option("--batch", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rate", default=5e-4, show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--start", type=click.Path(exists=True, file_okay=False, path_type=Path), help="A policy to go on from.")
def main(demonstrations: Path, out: Path, steps: int, batch: int, rate: float, seed: int, start: Path | None) -> None:
    """Train, and keep the averaged policy in --out as it goes."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    with np.load(demonstrations) as data:
        arrays = dict(data)
    named = {STATE: "state", PLACES: "places", ACTION: "action"}
    policy, processors = untrained({key: statistics(arrays[name]) for key, name in named.items()})
    if start is not None:
        policy.load_state_dict(load_file(start / "model.safetensors"))
    examples = windows(arrays)
    done = processors[0]({key: examples[key] for key in named})
    ready = {key: done[key] for key in named} | {"action_is_pad": examples["action_is_pad"]}
    optimizer = torch.optim.AdamW(policy.parameters(), rate, betas=(0.95, 0.999), weight_decay=1e-6)
    warm = steps / 20
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda k: min((k + 1) / warm, 0.5 + 0.5 * math.cos(math.pi * min(1.0, k / steps)))
    )
    averaged = AveragedModel(policy, avg_fn=average)
    policy.train()
    begun, recent = time.monotonic(), 0.0
    print(f"{len(ready[ACTION])} windows, {sum(p.numel() for p in policy.parameters()):,} weights", flush=True)
    for step, rows in zip(range(1, steps + 1), draw(len(ready[ACTION]), batch, seed), strict=False):
        loss, _ = policy.forward({key: value[rows] for key, value in ready.items()})
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        averaged.update_parameters(policy)
        recent += loss.item()
        if step % 100 == 0:
            print(f"step {step} loss {recent / 100:.4f} minutes {(time.monotonic() - begun) / 60:.1f}", flush=True)
            recent = 0.0
        if step % 500 == 0 or step == steps:
            save(averaged.module, processors, out / "policy")


if __name__ == "__main__":
    main()
