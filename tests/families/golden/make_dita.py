"""Run Dita's network on seeded weights, and write what it gives: ``dita.npz``, ``dita_words.npz``.

Not run by the tests. Needs a clone of RoboDita/Dita (66350e7)::

    python -m tests.families.golden.make_dita path/to/Dita
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .originals import Arrays, generator, noise_from, normal, on_cpu, seeded

SEED, BATCH, HORIZON, ACTIONS, WORDS, FRAMES, TOKENS, WIDTH = 19, 2, 6, 7, 3, 2, 4, 128
WHOLE, WHOLE_SEED = 77, 205
"""Tokens of an instruction as CLIP pads it; what it is given is drawn by the tests, too, and not stored."""


class _Tokens(nn.Module):
    """In place of the networks of the images: tokens ``[B, frames, tokens, E]`` pass through it."""

    tokens_per_context_image = TOKENS

    def __init__(self, **settings: Any) -> None:
        super().__init__()

    def forward(self, image: Tensor, *others: Tensor | None) -> Tensor:
        return image


def run(folder: Path) -> dict[str, Arrays]:
    """A prediction at two timesteps, and the actions of ``inference``, DDIM 10 of 100 steps."""
    images = ModuleType("vision_tokenizers.vit_tokenizer")
    images.__dict__["RT1ViTImageTokenizer"] = _Tokens
    sys.modules.update({"vision_tokenizers": ModuleType("vision_tokenizers"), images.__name__: images})
    sys.path.insert(0, str(folder / "scripts"))
    network = importlib.import_module("llama_dp").RobotTransformerNet(
        output_tensor_spec=None,
        trajectory_dim=ACTIONS,
        token_embedding_size=WIDTH,
        intermediate_size=80,
        num_layers=2,
        time_sequence_length=HORIZON,
        num_inference_steps=10,
    )
    seeded(network, SEED)
    # Ten steps on random weights amplify a change of the noise, rounding too: 20 to 1,000 times, by the seeds. Here it
    # is 30 times, and 45.
    few = _made(network, WORDS, 139)
    many = _made(network, WHOLE, WHOLE_SEED)
    return {"dita": few, "dita_words": {name: many[name] for name in ("seed", "noise", "actions")}}


def _made(network: Any, count: int, seed: int) -> Arrays:
    """What it gives to an instruction of so many tokens."""
    draw = normal(seed)
    words, frames = draw(BATCH, count, WIDTH), draw(BATCH, FRAMES, TOKENS, WIDTH)
    noise, timesteps = draw(BATCH, HORIZON, ACTIONS), torch.tensor([90, 30])
    observed = {
        "natural_language_embedding": torch.from_numpy(words)[:, None].expand(-1, FRAMES, -1, -1),
        "image": torch.from_numpy(frames),
    }
    chunk = HORIZON + 1 - FRAMES
    prediction = network(
        observed, None, noisy_action_tokens=torch.from_numpy(noise), timesteps=timesteps, num_pred_action=chunk
    )
    with noise_from(noise), on_cpu():
        made = network.inference(observed, num_pred_action=chunk)
    actions = [made[name] for name in ("world_vector", "rotation_delta", "gripper_closedness_action")]
    return {
        "seed": SEED,
        "prefix": np.concatenate([words, frames.reshape(BATCH, FRAMES * TOKENS, WIDTH)], 1),
        "noise": noise,
        "timesteps": timesteps.numpy(),
        "prediction": prediction.numpy(),
        "actions": torch.cat(actions, -1).numpy(),
    }


main = generator(run, "66350e7", "scripts")

if __name__ == "__main__":
    main()
