"""pi0 and pi0.5 at their real size with random weights, for ``large.py``, in the files that lerobot saves."""

from __future__ import annotations

from pathlib import Path

import torch
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json, write_processors

from ttscompile.policies.networks.language_layers import LanguageConfig
from ttscompile.policies.networks.pi import Pi, PiConfig
from ttscompile.policies.networks.siglip import SiglipConfig

GEMMA = LanguageConfig(width=2048, hidden=16384, layers=18, heads=8, groups=1, channels=256, gemma=True)
EXPERT = LanguageConfig(width=1024, hidden=4096, layers=18, heads=8, groups=1, channels=256, gemma=True)
VISION = SiglipConfig(
    hidden_size=1152,
    intermediate_size=4304,
    num_hidden_layers=27,
    num_attention_heads=16,
    image_size=224,
    patch_size=14,
)
"""PaliGemma's, in front of Gemma 2B; its expert has the width of Gemma 300M."""
_PADDED, _PERIODS = 32, (4e-3, 4.0)
_SIZES = {
    "chunk_size": 50,
    "n_action_steps": 50,
    "num_inference_steps": 10,
    "max_state_dim": _PADDED,
    "max_action_dim": _PADDED,
    "tokenizer_max_length": 48,
    "min_period": _PERIODS[0],
    "max_period": _PERIODS[1],
}
"""Lerobot's own, which a saved configuration has, and other programs read."""
_TEXT = "paligemma_with_expert.paligemma.model.language_model."


def save(directory: Path, adaptive: bool = False) -> None:
    """What lerobot's ``save_pretrained`` writes of a pi0 with its default configuration, in float32.

    Args:
        adaptive: of a pi0.5, under the names that its published files have, and with statistics of a data set.
    """
    directory.mkdir(parents=True, exist_ok=True)
    entries = {
        "type": "pi05" if adaptive else "pi0",
        "input_features": {key: FEATURES[key] for key in (STATE, *CAMERAS)},
        "output_features": {ACTION: FEATURES[ACTION]},
        **_SIZES,
    }
    if adaptive:
        numbers = {"mean": [0.0] * 6, "std": [1.0] * 6, "q01": [-1.0] * 6, "q99": [1.0] * 6}
        write_json(directory / "stats.json", {STATE: numbers, ACTION: numbers})
    write_json(directory / "config.json", entries | ({"tokenizer_max_length": 200} if adaptive else {}))
    write_processors(directory)
    config = PiConfig(
        vision=VISION,
        text=GEMMA,
        vocabulary=257152,
        expert=EXPERT,
        state=None if adaptive else _PADDED,
        actions=_PADDED,
        periods=_PERIODS,
    )
    start = "" if adaptive else "model."
    with torch.device("meta"):
        shapes = {f"{start}{_saved(name)}": value.shape for name, value in Pi(config).state_dict().items()}
    shapes[f"{start}{_TEXT}norm.weight"] = torch.Size((GEMMA.width,))  # no action depends on it
    save_drawn(directory / "model.safetensors", shapes)


def _saved(name: str) -> str:
    """A weight's name in a file of lerobot's, which has the head that is tied to the embedding of words."""
    head = name.replace(f"{_TEXT}embed_tokens", "paligemma_with_expert.paligemma.lm_head")
    return head.replace(".vision_tower.", ".vision_tower.vision_model.")
