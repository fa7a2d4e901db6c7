"""Teach a tiny CLIP vision tower where the block is, before the policy is trained with it.

    OMP_NUM_THREADS=1 python examples/policies/pixels/eyes.py build/policies/pictures.npz -o build/policies/clip-tiny

The tower starts from random weights. Its class token tells the nine keypoints of the block, through a linear layer that
is thrown away afterwards. Minutes of one core go much further this way than with the loss of the policy alone, which
says little about a picture. The result is a CLIP folder, as lerobot takes one of any size.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import click
import numpy as np
import torch
from torch.nn import functional
from transformers import CLIPModel

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from environments.pusht import keypoints  # noqa: E402
from multi_task_dit import make_encoder, picture_statistics  # noqa: E402

WORLD = 512.0
VISION = {
    "image_size": 64,
    "patch_size": 16,
    "hidden_size": 128,
    "intermediate_size": 512,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
}


@click.command()
@click.argument("drawn", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--steps", default=3500, show_default=True, type=click.IntRange(1))
@click.option("--batch", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rate", default=1e-3, show_default=True)
@click.option("--seed", default=0, show_default=True)
def main(drawn: Path, out: Path, steps: int, batch: int, rate: float, seed: int) -> None:
    """Train on the pictures of other states that pictures.py drew; the last 2000 of them only tell how well it does."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    make_encoder(out, VISION, seed)
    model = CLIPModel.from_pretrained(out)
    eyes = model.vision_model.train()
    head = torch.nn.Sequential(torch.nn.SiLU(), torch.nn.Linear(VISION["hidden_size"], 18))  # a DiT's layers begin so
    with np.load(drawn) as data:
        seen = picture_statistics(data["demonstrated"])
        images, states = data["drawn"], data["states"]
    wanted = torch.from_numpy(keypoints(states[:, 2:4], states[:, 4]).reshape(-1, 18) / (WORLD / 2) - 1).float()

    def told(chosen: np.ndarray) -> torch.Tensor:
        raw = torch.from_numpy(images[chosen]).permute(0, 3, 1, 2).float() / 255
        return head(eyes(pixel_values=(raw - seen["mean"]) / seen["std"]).last_hidden_state[:, 0])

    weights = [*eyes.parameters(), *head.parameters()]
    optimizer = torch.optim.AdamW(weights, lr=rate, betas=(0.9, 0.99), weight_decay=1e-2, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda k: min((k + 1) / 300, 0.5 + 0.5 * math.cos(math.pi * min(1.0, k / steps)))
    )
    generator, held, begun = np.random.default_rng(seed), np.arange(len(images) - 2000, len(images)), time.monotonic()
    for step in range(1, steps + 1):
        chosen = generator.integers(held[0], size=batch)
        optimizer.zero_grad()
        functional.l1_loss(told(chosen), wanted[chosen]).backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        schedule.step()
        if step % 250 == 0 or step == steps:
            with torch.no_grad():
                off = (told(held) - wanted[held]).abs().mean().item() * WORLD / 2
            print(f"step {step} off {off:.2f} px minutes {(time.monotonic() - begun) / 60:.1f}", flush=True)
            model.save_pretrained(out)


if __name__ == "__main__":
    main()
