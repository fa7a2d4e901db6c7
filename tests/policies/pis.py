"""Tiny pi0 and pi0.5 policies with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_pi.py`` gives lerobot the same directories, observations and noise.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from ttscompile.policies.networks.language_layers import LanguageConfig
from ttscompile.policies.networks.pi import Pi, PiConfig
from ttscompile.policies.networks.siglip import SiglipConfig

from .hybrid import fill
from .lerobot_tiny import write_json
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array

KINDS = ("pi0", "pi05")
STATE_DIM, ACTION_DIM, PADDED, HORIZON, LENGTH, VOCABULARY, STEPS = 4, 5, 7, 6, 8, 50, 4
PROMPT = "pi05_prepare_state_tokenizer_processor_step"
TASKS = ("Push_the block", " pick up\nthe cup ")
TRAINED = 3
"""The longest prefix that a pi0.5 that was trained with prefixes takes."""
SIZES = ((28, 28), (40, 24))
"""Height and width of the images of each call; the first is what the encoder sees."""

TEXT = LanguageConfig(width=24, hidden=40, layers=2, heads=8, groups=1, channels=8, gemma=True)
EXPERT = LanguageConfig(width=16, hidden=28, layers=2, heads=8, groups=1, channels=8, gemma=True)
VISION = SiglipConfig(
    hidden_size=32, intermediate_size=20, num_hidden_layers=1, num_attention_heads=16, image_size=28, patch_size=14
)
_MODES = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "QUANTILES"}


def config(kind: str) -> PiConfig:
    """Sizes of a policy."""
    state = PADDED if kind == "pi0" else None
    return PiConfig(VISION, TEXT, VOCABULARY, EXPERT, state, PADDED, (4e-3, 4.0))


def save(kind: str, directory: Path, dtype: str = "float32", prompt: bool = False) -> Path:
    """Save a policy as lerobot does, without the tokenizer. Returns the directory.

    Args:
        dtype: that lerobot computes in.
        prompt: write the step, too, that puts pi0.5's state into its instruction.
    """
    directory.mkdir(parents=True)
    inputs: dict[str, Any] = {STATE: {"type": "STATE", "shape": [STATE_DIM]}}
    inputs |= {key: {"type": "VISUAL", "shape": [3, *SIZES[0]]} for key in CAMERAS}
    outputs = {"action": {"type": "ACTION", "shape": [ACTION_DIM]}}
    entries: dict[str, Any] = {"type": kind, "device": "cpu", "input_features": inputs, "output_features": outputs}
    entries |= {"chunk_size": HORIZON, "n_action_steps": 4, "max_state_dim": PADDED, "max_action_dim": PADDED}
    entries |= {"num_inference_steps": STEPS, "image_resolution": list(SIZES[0]), "tokenizer_max_length": LENGTH}
    write_json(directory / "config.json", entries | {"normalization_mapping": _MODES, "dtype": dtype})
    norm = {"eps": 1e-8, "features": inputs | outputs, "norm_map": _MODES}
    statistics: dict[str, torch.Tensor] = {}
    for key, count in ((STATE, STATE_DIM), ("action", ACTION_DIM)):
        low = torch.linspace(-1.5, 0.5, count)
        statistics |= {f"{key}.{name}": low.clone() for name in ("mean", "q01")}
        statistics |= {f"{key}.std": low.abs() + 0.5, f"{key}.q99": low + 2}
    save_file(statistics, directory / "statistics.safetensors")
    for name, registered in (("pre", "normalizer_processor"), ("post", "unnormalizer_processor")):
        step = {"registry_name": registered, "config": norm, "state_file": "statistics.safetensors"}
        pipeline = f"policy_{name}processor"
        more = [{"registry_name": PROMPT, "config": {"max_state_dim": PADDED}}] if prompt and name == "pre" else []
        write_json(directory / f"{pipeline}.json", {"name": pipeline, "steps": [step, *more]})
    save_file(weights(kind), directory / "model.safetensors")
    return directory


def weights(kind: str) -> dict[str, torch.Tensor]:
    """Under the names that lerobot saves, with transformers 5."""
    drawn = fill(dict(Pi(config(kind)).state_dict()), 3)
    # Smaller, so that rounding is not magnified from layer to layer.
    return {f"model.{name}": value * (0.6 if value.ndim > 1 else 1) for name, value in drawn.items()}


def observation(call: int) -> dict[str, Array]:
    """One frame of one stream; of the second call's images the size is another, and so is the instruction."""
    rng = np.random.RandomState(call)
    found: dict[str, Array] = {STATE: rng.standard_normal((1, STATE_DIM)).astype(np.float32)}
    found |= {key: rng.uniform(0, 1, (1, 3, *SIZES[call])).astype(np.float32) for key in CAMERAS}
    found[TOKENS] = rng.randint(0, VOCABULARY, (1, LENGTH))
    found[MASK] = np.arange(LENGTH)[None] < 3 + 3 * call
    return found


def noise() -> Array:
    """``[1, T, D]``."""
    return np.random.RandomState(11).standard_normal((1, HORIZON, PADDED)).astype(np.float32)


def states() -> Array:
    """``[6, D]``, of robots whose state is anywhere: far outside, at edges of ranges, and between."""
    drawn = np.random.RandomState(7).standard_normal((6, STATE_DIM)).astype(np.float32)
    ends = np.linspace(-1.5, 0.5, STATE_DIM, dtype=np.float32)
    return np.concatenate([drawn[:3] * 4, drawn[3:4], ends[None], ends[None] + 2])


def left_over() -> Array:
    """What is left of a chunk as the network gives it, ``[1, N, Da]``; executed at the end are fewer than N."""
    return np.random.RandomState(5).uniform(-1, 1, (1, TRAINED + 1, ACTION_DIM)).astype(np.float32)
