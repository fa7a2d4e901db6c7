"""Train a diffusion policy for Push-T from pixels: LeRobot's ``multi_task_dit``, with lerobot's own code.

    OMP_NUM_THREADS=1 python examples/policies/pixels/train.py pusht_demonstrations.npz build/policies/pictures.npz \\
        build/policies/clip-tiny -o build/policies/pixels

It observes pictures of 64 x 64 and the agent's position. First the denoiser is trained on what the image encoder of
``eyes.py`` makes of each frame, computed once since the encoder does not change; then both are trained together, the
encoder with lerobot's smaller learning rate.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import click
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig

sys.path[1:1] = [str(Path(__file__).parents[1])]

from multi_task_dit import (  # noqa: E402
    ENCODER,
    TASK,
    TOKENS,
    Policy,
    draw,
    picture_statistics,
    statistics,
    window_indices,
)

WINDOW, HORIZON, EXECUTED, STEPS = 2, 10, 8, 20
STATE, IMAGE = "observation.state", "observation.image"


def configuration(size: int) -> MultiTaskDiTConfig:
    """4 layers of width 128; 20 steps of DDIM."""
    return MultiTaskDiTConfig(
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (2,)),
            IMAGE: PolicyFeature(FeatureType.VISUAL, (3, size, size)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        device="cpu",
        push_to_hub=False,
        n_obs_steps=WINDOW,
        horizon=HORIZON,
        n_action_steps=EXECUTED,
        objective="diffusion",
        noise_scheduler_type="DDIM",
        num_inference_steps=STEPS,
        hidden_dim=128,
        num_layers=4,
        num_heads=4,
        dropout=0.0,
        timestep_embed_dim=64,
        vision_encoder_name=ENCODER,
        text_encoder_name=ENCODER,
        image_crop_shape=None,
        tokenizer_max_length=TOKENS,
    )


@click.command()
@click.argument("demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("drawn", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("encoder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--steps", default=4000, show_default=True, type=click.IntRange(0), help="With the encoder as it is.")
@click.option("--together", default=500, show_default=True, type=click.IntRange(0), help="With the encoder.")
@click.option("--batch", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rate", default=6e-4, show_default=True)
@click.option("--seed", default=0, show_default=True)
def main(
    demonstrations: Path,
    drawn: Path,
    encoder: Path,
    out: Path,
    steps: int,
    together: int,
    batch: int,
    rate: float,
    seed: int,
) -> None:
    """Train, and keep the averaged policy in --out as it goes."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    out = out.resolve()
    shutil.copytree(encoder, out / ENCODER, dirs_exist_ok=True)
    with np.load(demonstrations) as data:
        agent, acted = data["state"][:, :2].astype(np.float32), data["action"].astype(np.float32)
        before, after = window_indices(data["episode_ends"], WINDOW, HORIZON, EXECUTED)
    with np.load(drawn) as data:
        pictures = data["demonstrated"]
    os.chdir(out)  # lerobot finds the encoder by its name
    stats = {STATE: statistics(agent), IMAGE: picture_statistics(pictures), "action": statistics(acted)}
    policy = Policy(configuration(pictures.shape[1]), stats, seed)

    def prepared(pixels: torch.Tensor, seen: torch.Tensor, done: torch.Tensor) -> dict[str, torch.Tensor]:
        raw = {STATE: torch.from_numpy(agent)[seen], "action": torch.from_numpy(acted)[done]}
        made = policy.prepare({**raw, IMAGE: pixels, "task": [TASK]})
        return {name: value for name, value in made.items() if isinstance(value, torch.Tensor)}

    def pixels(seen: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(pictures)[seen].movedim(-1, -3).float() / 255

    def save() -> None:
        policy.save(out / "policy", out / ENCODER)

    frames = {"seen": torch.from_numpy(before), "action": torch.from_numpy(after)}
    if steps:
        windows = prepared(torch.zeros(1), frames["seen"], frames["action"])
        seen = [policy.look(prepared(pixels(some), some, some)[IMAGE]) for some in torch.arange(len(agent)).split(256)]
        with policy.looked():
            policy.train(draw({**windows, IMAGE: torch.cat(seen)[frames["seen"]]}, batch, seed), steps, rate, save)
    if together:
        chosen = draw(frames, batch, seed + 1)
        policy.train((prepared(pixels(b["seen"]), b["seen"], b["action"]) for b in chosen), together, rate / 3, save)


if __name__ == "__main__":
    main()
