"""Run the action experts of pi0 and pi0.5 on seeded weights, and write what they give: ``pi0.npz`` and ``pi05.npz``.

Not run by the tests. Needs a clone of huggingface/lerobot (7427f31)::

    python -m tests.families.golden.make_pi path/to/lerobot
"""

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn
from transformers import DynamicCache
from transformers.masking_utils import create_causal_mask

from .originals import Arrays, generator, lerobot, normal, seeded

BATCH, HORIZON, ACTIONS, PREFIX, LAYERS, CHANNELS = 2, 6, 5, 7, 2, 8


def run(folder: Path) -> dict[str, Arrays]:
    """Both policies, each with weights of its own."""
    lerobot(folder, "pi0", "pi05")
    return {"pi0": _run("pi0", 11), "pi05": _run("pi05", 12)}


def _run(name: str, seed: int) -> Arrays:
    """The velocity at two timesteps, and the actions of ten Euler steps; part of one prefix is masked."""
    original = importlib.import_module(f"lerobot.policies.{name}.modeling_{name}")
    model: Any = _expert(original, getattr(original, f"{name.upper()}Pytorch"))
    seeded(model, seed, "paligemma_with_expert.paligemma.", "paligemma_with_expert.gemma_expert.lm_head.")
    draw = normal(seed + 100)
    keys, values = (draw(BATCH, LAYERS, PREFIX, 1, CHANNELS) for _ in range(2))
    mask = np.ones((BATCH, PREFIX), bool)
    mask[1, 4:6] = False
    noise, state, timesteps = draw(BATCH, HORIZON, ACTIONS), draw(BATCH, ACTIONS), np.array([1.0, 0.3], np.float32)
    own = {"state": torch.from_numpy(state)} if name == "pi0" else {}  # pi0.5 reads the state as words

    def step(sample: Tensor, timestep: Tensor) -> Tensor:
        cache = DynamicCache()
        for layer in range(LAYERS):
            key, value = (torch.from_numpy(each[:, layer]).transpose(1, 2).contiguous() for each in (keys, values))
            cache.update(key, value, layer)
        given = {"prefix_pad_masks": torch.from_numpy(mask), "past_key_values": cache, **own}
        return model.denoise_step(**given, x_t=sample, timestep=timestep)

    # transformers 5.23 has no such argument.
    without = patch(
        "lerobot.policies.pi_gemma.create_causal_mask", lambda cache_position, **given: create_causal_mask(**given)
    )
    with without:
        velocity = step(torch.from_numpy(noise), torch.from_numpy(timesteps))
        actions = original.euler_integrate(step, torch.from_numpy(noise), 10)
    return {
        "seed": seed,
        "prefix_mask": mask,
        "keys": keys,
        "values": values,
        "noise": noise,
        "timesteps": timesteps,
        "velocity": velocity.numpy(),
        "actions": actions.numpy(),
        **({"state": state} if name == "pi0" else {}),
    }


def _expert(original: Any, policy: type[nn.Module]) -> nn.Module:
    """The original's network with a Gemma expert of two small layers, and without PaliGemma."""
    tiny = original.GemmaConfig(width=24, depth=LAYERS, mlp_dim=40, num_heads=4, num_kv_heads=1, head_dim=CHANNELS)
    settings = SimpleNamespace(
        paligemma_variant="tiny",
        action_expert_variant="tiny",
        image_resolution=(224, 224),
        dtype="float32",
        freeze_vision_encoder=False,
        train_expert_only=False,
        max_action_dim=ACTIONS,
        max_state_dim=ACTIONS,
        use_proprioceptive_memory=False,
        compile_model=False,
        chunk_size=HORIZON,
        min_period=4e-3,
        max_period=4.0,
    )
    with (
        patch.object(original, "get_gemma_config", lambda variant: tiny),
        patch.object(original, "PaliGemmaForConditionalGenerationWithPiGemma", lambda config: nn.Identity()),
    ):
        return policy(settings)


main = generator(run, "7427f31", "src/lerobot")

if __name__ == "__main__":
    main()
