"""Keep a trained policy in half precision, with what lerobot answers with it, for the tests.

MUJOCO_GL=osmesa python examples/policies/vla/keep.py build/vla/smolvla examples/policies/vla/trained/smolvla
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from safetensors.torch import load_file, save_file

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

import dit
import smolvla
from environments.fetch_blocks import TASKS, FetchBlocks

SEED = 200_000
FILES = ("config.json", "tokenizer.json", "tokenizer_config.json")
"""Of a language model, or of CLIP."""


@click.command()
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
def main(run: Path, out: Path) -> None:
    """Write ``policy/``, its language model's files and ``answers.npz`` into OUT; RUN is the folder of ``train.py``."""
    out = out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(run / "policy", out / "policy")
    for name in (smolvla.NAME, dit.NAME):
        if (run / name).is_dir():
            (out / name).mkdir()
            for file in FILES:
                shutil.copy(run / name / file, out / name)
    weights = out / "policy" / "model.safetensors"
    save_file({name: value.half() for name, value in load_file(weights).items()}, weights, {"format": "pt"})
    os.chdir(run)  # lerobot reads files of the language model's folder that are not kept
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    np.savez_compressed(out / "answers.npz", **answers(out / "policy"))


def answers(directory: Path) -> dict[str, Any]:
    """What lerobot answers in the first frame of an episode of every task.

    Returns:
        Frames by key ``[N, ...]``, ``instruction [N]``, ``action [N, Ta, Da]``, and the noise: ``noise [N, T, D]`` and,
        of a sampler that draws at its steps, ``steps [K, N, T, D]``.
    """
    kind = json.loads((directory / "config.json").read_text())["type"]
    policy: Any = get_policy_class(kind).from_pretrained(directory).eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=directory)
    world, frames, words = FetchBlocks(), [], []
    for seed in range(SEED, SEED + len(TASKS)):
        world.reset(seed)
        frames.append(world.observe())
        words.append(world.instruction)
    world.close()
    stacked = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
    given: dict[str, Any] = {key: torch.from_numpy(value) for key, value in stacked.items() if "language" not in key}
    batch = before({**given, "task": words})
    draws, noise = torch.Generator().manual_seed(SEED), {}
    torch.manual_seed(SEED)  # what is drawn below is what lerobot draws by itself, in this order
    with torch.no_grad():
        if kind == "smolvla":
            shape = (len(TASKS), policy.config.chunk_size, policy.config.max_action_dim)
            noise["noise"] = torch.randn(shape, generator=draws)
            chunks = policy.predict_action_chunk(batch, noise=noise["noise"])
        else:
            chunks = policy._generate_actions(policy._prepare_batch(dit.of_one_frame(batch)))
            shape = (len(TASKS), policy.config.horizon, policy.config.action_feature.shape[0])
            noise["noise"] = torch.randn(shape, generator=draws)
            steps = range(policy.config.num_train_timesteps)
            noise["steps"] = torch.stack([torch.randn(shape, generator=draws) for _ in steps])
    action = after(chunks).numpy()[:, : policy.config.n_action_steps]
    numbers = {name: value.numpy() for name, value in noise.items()}
    return {**stacked, **numbers, "instruction": np.array(words), "action": action}


if __name__ == "__main__":
    main()
