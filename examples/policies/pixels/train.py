"""Train a flow-matching policy for Push-T from pixels: LeRobot's ``multi_task_dit``, with lerobot's own code.

    OMP_NUM_THREADS=1 python examples/policies/pixels/train.py pusht_demonstrations.npz build/policies/pictures.npz \\
        build/policies/clip-tiny examples/policies/flow/policy -o build/policies/pixels

It observes pictures of 64 x 64 and the agent's position, through the image encoder of ``eyes.py``. It starts from the
policy of ``flow``, which observes keypoints: what the layers made of those they make of the encoder's class token, by
least squares. Then the denoiser is trained on what the encoder makes of each frame, computed once since the encoder
does not change; and then, if that is asked for, both together.
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
from safetensors.torch import load_file
from torch.nn import functional

sys.path[1:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "evaluation")]

from environments.pusht import observation  # noqa: E402
from lerobot_training import draw, statistics, window_indices  # noqa: E402
from multi_task_dit import ENCODER, EXECUTED, HORIZON, STATE, WINDOW, Policy, configuration, picture_statistics  # noqa: E402

IMAGE = "observation.image"


def start_from(policy: Policy, source: dict[str, torch.Tensor], points: torch.Tensor, seen: torch.Tensor) -> None:
    """Give the network the weights of the policy that observes keypoints.

    The condition of a layer is, behind the timestep and for each of the frames, [18 keypoints, agent, task] there and
    [agent, class token, task] here, each after a SiLU. The columns of the keypoints become columns of the class token.

    Args:
        policy: from pixels.
        source: weights of the other policy.
        points: ``[F, 18]`` the keypoints as the other policy observes them: normalised.
        seen: ``[F, width]`` class tokens of the same frames.
    """
    known = torch.cat([functional.silu(seen), torch.ones(len(seen), 1)], dim=1)
    made = torch.linalg.lstsq(known.double(), functional.silu(points).double()).solution.float()  # [width + 1, 18]
    rest = functional.silu(points) - known @ made
    print(f"of the keypoints {1 - rest.var() / functional.silu(points).var():.4f} is explained", flush=True)
    weights = policy.network.state_dict()
    for name, value in source.items():
        if not name.endswith("adaLN_modulation.1.weight"):
            if not name.endswith("adaLN_modulation.1.bias"):
                weights[name] = value.float()
            continue
        width = value.shape[1] - policy.network.config.timestep_embed_dim
        time, *frames = value.float().split([value.shape[1] - width, *[width // WINDOW] * WINDOW], dim=1)
        bias = weights[name.replace("weight", "bias")] = source[name.replace("weight", "bias")].float().clone()
        columns = [time]
        for frame in frames:
            keypoint, agent, task = frame.split([18, 2, frame.shape[1] - 20], dim=1)
            columns += [agent, keypoint @ made[:-1].T, task]
            bias += keypoint @ made[-1]
        weights[name] = torch.cat(columns, dim=1)
    policy.network.load_state_dict(weights)


@click.command()
@click.argument("demonstrations", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("drawn", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("encoder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("keypoint_policy", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path))
@click.option("--steps", default=1500, show_default=True, type=click.IntRange(0), help="With the encoder as it is.")
@click.option("--together", default=0, show_default=True, type=click.IntRange(0), help="With the encoder.")
@click.option("--batch", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rate", default=3e-4, show_default=True)
@click.option("--seed", default=0, show_default=True)
def main(
    demonstrations: Path,
    drawn: Path,
    encoder: Path,
    keypoint_policy: Path,
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
        observed, acted = observation(data["state"]), data["action"].astype(np.float32)
        before, after = window_indices(data["episode_ends"], WINDOW, HORIZON, EXECUTED)
    with np.load(drawn) as data:
        pictures = data["demonstrated"]
    agent, source = observed[:, 18:], load_file(keypoint_policy / "model.safetensors")
    os.chdir(out)  # lerobot finds the encoder by its name
    stats = {STATE: statistics(agent), IMAGE: picture_statistics(pictures), "action": statistics(acted)}
    picture = PolicyFeature(FeatureType.VISUAL, (3, *pictures.shape[1:3]))
    policy = Policy(configuration({STATE: PolicyFeature(FeatureType.STATE, (2,)), IMAGE: picture}), stats, seed)

    def prepared(pixels: torch.Tensor, seen: torch.Tensor, done: torch.Tensor) -> dict[str, torch.Tensor]:
        raw = {STATE: torch.from_numpy(agent)[seen], "action": torch.from_numpy(acted)[done]}
        return policy.prepare({**raw, IMAGE: pixels})

    def pixels(seen: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(pictures)[seen].movedim(-1, -3).float() / 255

    def save() -> None:
        policy.save(out / "policy", out / ENCODER)

    frames = {"seen": torch.from_numpy(before), "action": torch.from_numpy(after)}
    seen = torch.cat([policy.look(prepared(pixels(s), s, s)[IMAGE]) for s in torch.arange(len(agent)).split(256)])
    low, high = observed[:, :18].min(0), observed[:, :18].max(0)
    start_from(policy, source, torch.from_numpy(2 * (observed[:, :18] - low) / (high - low) - 1), seen.flatten(1))
    policy.average_from_here()
    save()
    if steps:
        windows = prepared(torch.zeros(1), frames["seen"], frames["action"])
        with policy.looked():
            policy.train(draw({**windows, IMAGE: seen[frames["seen"]]}, batch, seed), steps, rate, save)
    if together:
        chosen = draw(frames, batch, seed + 1)
        policy.train((prepared(pixels(b["seen"]), b["seen"], b["action"]) for b in chosen), together, rate / 3, save)


if __name__ == "__main__":
    main()
