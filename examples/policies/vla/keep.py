"""Keep a trained policy in half precision, with what lerobot answers with it, for the tests.

MUJOCO_GL=osmesa python examples/policies/vla/keep.py build/vla/run examples/policies/vla
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from safetensors.torch import load_file, save_file

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import TASKS, FetchBlocks
from smolvla import NAME

SEED = 200_000
LANGUAGE_MODEL = ("config.json", "tokenizer.json", "tokenizer_config.json")


@click.command()
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
def main(run: Path, out: Path) -> None:
    """Write ``policy/``, ``language-model/`` and ``answers.npz`` into OUT; RUN is the folder of ``train.py``."""
    out = out.resolve()
    for name in ("policy", NAME):
        shutil.rmtree(out / name, ignore_errors=True)
    shutil.copytree(run / "policy", out / "policy")
    (out / NAME).mkdir()
    for name in LANGUAGE_MODEL:
        shutil.copy(run / NAME / name, out / NAME)
    weights = out / "policy" / "model.safetensors"
    save_file({name: value.half() for name, value in load_file(weights).items()}, weights, {"format": "pt"})
    os.chdir(run)  # lerobot reads the whole language model's folder, of which its processor's files are not kept
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    np.savez_compressed(out / "answers.npz", **answers(out / "policy"))


def answers(directory: Path) -> dict[str, Any]:
    """Frames of every task by key ``[N, ...]``, ``instruction [N]``, ``noise [N, T, D]`` and ``action [N, Ta, Da]``."""
    policy = SmolVLAPolicy.from_pretrained(directory).eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=directory)
    world, frames, words = FetchBlocks(), [], []
    for seed in range(SEED, SEED + len(TASKS)):
        world.reset(seed)
        frames.append(world.observe())
        words.append(world.instruction)
    world.close()
    stacked = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
    given: dict[str, Any] = {key: torch.from_numpy(value) for key, value in stacked.items() if "language" not in key}
    shape = (len(TASKS), policy.config.chunk_size, policy.config.max_action_dim)
    noise = np.random.default_rng(SEED).standard_normal(shape, dtype=np.float32)
    with torch.no_grad():
        chunks = policy.predict_action_chunk(before({**given, "task": words}), noise=torch.from_numpy(noise))
    action = after(chunks).numpy()[:, : policy.config.n_action_steps]
    return {**stacked, "instruction": np.array(words), "noise": noise, "action": action}


if __name__ == "__main__":
    main()
