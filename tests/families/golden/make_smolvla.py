"""Run SmolVLA's action expert on seeded weights, and write what it gives: ``smolvla.npz``.

Not run by the tests. Needs a clone of huggingface/lerobot (7427f31)::

    python -m tests.families.golden.make_smolvla path/to/lerobot
"""

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn
from transformers import DynamicCache, SmolVLMConfig

from .originals import Arrays, generator, lerobot, normal, seeded

SEED, BATCH, HORIZON, ACTIONS, PREFIX, LAYERS, GROUPS, CHANNELS = 5, 2, 6, 5, 7, 4, 2, 8


class _Cache(DynamicCache):
    """Keys and values of the prefix, for one step only: transformers 5.23 cannot crop as LeRobot asks for."""

    def crop(self, length: int) -> None:
        pass


def run(folder: Path) -> dict[str, Arrays]:
    """The velocity at two timesteps, and the actions of ten Euler steps; part of one prefix is masked."""
    lerobot(folder, "smolvla")
    original = importlib.import_module("lerobot.policies.smolvla.modeling_smolvla")
    model: Any = _expert(original)
    seeded(model, SEED, "vlm_with_expert.vlm.")
    draw = normal(6)
    keys, values = (draw(LAYERS, BATCH, GROUPS, PREFIX, CHANNELS) for _ in range(2))
    mask = np.ones((BATCH, PREFIX), bool)
    mask[1, 4:6] = False
    noise, timesteps = draw(BATCH, HORIZON, ACTIONS), np.array([1.0, 0.3], np.float32)

    def step(sample: Tensor, timestep: Tensor) -> Tensor:
        cache = _Cache()
        for layer in range(LAYERS):
            cache.update(torch.from_numpy(keys[layer]), torch.from_numpy(values[layer]), layer)
        given = {"prefix_pad_masks": torch.from_numpy(mask), "past_key_values": cache}
        return model.denoise_step(**given, x_t=sample, timestep=timestep)

    velocity = step(torch.from_numpy(noise), torch.from_numpy(timesteps))
    actions = original.euler_integrate(step, torch.from_numpy(noise), 10)
    return {
        "smolvla": {
            "seed": SEED,
            "keys": keys.transpose(1, 0, 3, 2, 4),  # [B, layer, token, group, channel]
            "values": values.transpose(1, 0, 3, 2, 4),
            "noise": noise,
            "timesteps": timesteps,
            "velocity": velocity.numpy(),
            "actions": actions.numpy(),
            "prefix_mask": mask,
        }
    }


def _expert(original: Any) -> nn.Module:
    """The original's network on a SmolVLM of four small layers, every second of which attends to the prefix alone."""
    text = {
        "model_type": "llama",
        "hidden_size": 32,
        "intermediate_size": 48,
        "num_hidden_layers": LAYERS,
        "num_attention_heads": 4,
        "num_key_value_heads": GROUPS,
        "head_dim": CHANNELS,
        "vocab_size": 64,
        "pad_token_id": 0,
    }
    vision = {
        "hidden_size": 16,
        "intermediate_size": 16,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 16,
        "patch_size": 8,
    }
    settings: Any = {"pad_token_id": 0}  # not in its signature
    tiny = SmolVLMConfig(text_config=text, vision_config=vision, **settings)
    tokenizer = SimpleNamespace(fake_image_token_id=1, global_image_token_id=2)
    settings = SimpleNamespace(
        vlm_model_name="none",
        freeze_vision_encoder=True,
        train_expert_only=True,
        load_vlm_weights=False,
        attention_mode="cross_attn",
        num_expert_layers=-1,
        num_vlm_layers=LAYERS,
        self_attn_every_n_layers=2,
        expert_width_multiplier=0.75,
        device="cpu",
        max_state_dim=6,
        max_action_dim=ACTIONS,
        train_state_proj=True,
        add_image_special_tokens=False,
        prefix_length=-1,
        rtc_config=None,
        compile_model=False,
        min_period=4e-3,
        max_period=4.0,
        chunk_size=HORIZON,
        num_steps=10,
        use_cache=True,
    )
    place = "lerobot.policies.smolvla.smolvlm_with_expert"
    with (
        patch(f"{place}.AutoConfig.from_pretrained", lambda name: tiny),
        patch(f"{place}.AutoProcessor.from_pretrained", lambda name: SimpleNamespace(tokenizer=tokenizer)),
        patch(f"{place}.get_intermediate_size", lambda width: 40),  # otherwise a multiple of 256
    ):
        return original.VLAFlowMatching(settings).float()


main = generator(run, "7427f31", "src/lerobot")

if __name__ == "__main__":
    main()
