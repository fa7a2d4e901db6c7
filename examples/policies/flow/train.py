"""Train a flow-matching policy for Push-T from keypoints: LeRobot's ``multi_task_dit``, with lerobot's own code.

    OMP_NUM_THREADS=1 python examples/policies/flow/train.py pusht_demonstrations.npz -o build/policies/flow

The demonstrations are those that were published with Diffusion Policy: ``state [F, 5]``, ``action [F, 2]`` and
``episode_ends``. The policy observes what that of ``examples/pusht`` does, and integrates ten steps.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from safetensors.torch import load_file

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from environments.pusht import observation  # noqa: E402
from lerobot_training import draw, statistics, window_indices  # noqa: E402
from multi_task_dit import ENCODER, EXECUTED, HORIZON, STATE, WINDOW, Policy, configuration, make_encoder  # noqa: E402


@click.command()
@click.argument("demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--steps", default=4500, show_default=True, type=click.IntRange(1))
@click.option("--batch", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rate", default=6e-4, show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--start", type=click.Path(exists=True, file_okay=False, path_type=Path), help="A policy to go on from.")
def main(demonstrations: Path, out: Path, steps: int, batch: int, rate: float, seed: int, start: Path | None) -> None:
    """Train, and keep the averaged policy in --out as it goes."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    make_encoder(out / ENCODER, {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}, seed)
    start = None if start is None else start.resolve()
    os.chdir(out)  # lerobot finds the encoder by its name
    with np.load(demonstrations) as data:
        observed, acted = observation(data["state"]), data["action"].astype(np.float32)
        before, after = window_indices(data["episode_ends"], WINDOW, HORIZON, EXECUTED)
    feature = PolicyFeature(FeatureType.STATE, (20,))
    policy = Policy(configuration({STATE: feature}), {STATE: statistics(observed), "action": statistics(acted)}, seed)
    if start is not None:
        policy.network.load_state_dict(load_file(start / "model.safetensors"))
    raw = {STATE: torch.from_numpy(observed[before]), "action": torch.from_numpy(acted[after])}
    windows = policy.prepare(raw)
    policy.train(draw(windows, batch, seed), steps, rate, lambda: policy.save(out / "policy", out / ENCODER))


if __name__ == "__main__":
    main()
