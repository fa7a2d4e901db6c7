"""Train LeRobot's ``diffusion``, a U-Net with 100 steps of DDPM, for an SO-101 arm, with lerobot's own code.

    OMP_NUM_THREADS=1 python examples/policies/so101/train.py demonstrations.npz -o build/policies/so101

The policy observes two frames of the arm, the block and the place, predicts 16 actions and executes eight. Its settings
are lerobot's, but for the widths of the network (lerobot's levels have 512, 1024 and 2048 channels). lerobot has to be
importable; none of its code is here.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from safetensors.torch import load_file
from torch.optim.swa_utils import AveragedModel

sys.path.insert(1, str(Path(__file__).parents[1]))

from lerobot_training import average, draw, saving, statistics, window_indices

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
    before, after = window_indices(data["episode_ends"], WINDOW, HORIZON, 1)
    kept = ~data["pushed"].astype(bool)[after[:, WINDOW - 1 : WINDOW - 1 + EXECUTED]].any(1)
    named = ((STATE, "state", before), (PLACES, "places", before), (ACTION, "action", after))
    made = {key: torch.from_numpy(data[name][rows[kept]]) for key, name, rows in named}
    return made | {"action_is_pad": torch.zeros(int(kept.sum()), HORIZON, dtype=torch.bool)}


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
    for step, drawn in zip(range(1, steps + 1), draw(ready, batch, seed), strict=False):
        loss, _ = policy.forward(drawn)
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
            network: Any = averaged.module
            with saving(out / "policy") as beside:
                for each in (network, *processors):
                    each.save_pretrained(beside)


if __name__ == "__main__":
    main()
