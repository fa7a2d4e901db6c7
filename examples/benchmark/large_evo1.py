"""Evo-1 at its real size with random weights, for ``large.py``: the checkpoint, and its language model's files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, random_weight, write_json, write_processors
from safetensors.torch import save_file

from ttscompile.frontends.families import AS_SAVED
from ttscompile.frontends.settings import Settings
from ttscompile.policies.lerobot.evo1 import read_config
from ttscompile.policies.lerobot.vla import read_vla_config
from ttscompile.policies.networks.evo1 import Evo1
from ttscompile.policies.networks.internvl import Prompt

TASK = "put the red cup on the shelf"
MODEL: dict[str, Any] = {
    "model_type": "internvl",
    "image_token_id": 151667,
    "vision_config": {"attention_bias": True},
    "text_config": {
        "model_type": "qwen2",
        "hidden_size": 896,
        "intermediate_size": 4864,
        "num_hidden_layers": 24,
        "num_attention_heads": 14,
        "num_key_value_heads": 2,
        "rope_theta": 1e6,
        "vocab_size": 151674,
    },
}
"""InternVL3-1B; other entries are the defaults."""
STEPS, PADDED = 32, 24
"""Of a call; and numbers of a state and of an action."""
_SIZES = {
    "chunk_size": 50,
    "num_inference_timesteps": STEPS,
    "max_state_dim": PADDED,
    "max_action_dim": PADDED,
    "max_views": len(CAMERAS),
}
"""Lerobot's own, but for a prompt of as many images as there are cameras."""
_MARKS = {"<img>": 151665, "</img>": 151666, "<IMG_CONTEXT>": 151667}


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of an evo1 with its default configuration."""
    model = directory.parent / "InternVL3-1B-hf"
    for each in (directory, model):
        each.mkdir(parents=True, exist_ok=True)
    write_json(model / "config.json", MODEL)
    save_letters(model, _MARKS)
    entries = {
        "type": "evo1",
        "input_features": {key: FEATURES[key] for key in (STATE, *CAMERAS)},
        "output_features": {ACTION: FEATURES[ACTION]},
        "vlm_model_name": f"OpenGVLab/{model.name}",
        **_SIZES,
    }
    write_json(directory / "config.json", entries)
    write_processors(directory)
    shared = read_vla_config(directory, entries, AS_SAVED)
    with torch.device("meta"):
        shapes = Evo1(read_config(shared, Settings(MODEL, "")), Prompt((), len(CAMERAS))).state_dict()
    draw = torch.Generator().manual_seed(0)
    weights = {f"model.{name}": _weight(name, value.shape, draw) for name, value in shapes.items()}
    save_file(weights, directory / "model.safetensors")


def save_letters(folder: Path, marks: Mapping[str, int], size: int = 0) -> None:
    """A tokenizer of which each letter is a token, since this is nobody's text, and marks by their numbers.

    Args:
        size: it has as many tokens, most of which nothing is; 0 for those that there are.
    """
    letters = {chr(code): code for code in range(32, 127)}
    taken = {*letters.values(), *marks.values()}
    letters |= {f"nothing {number}": number for number in range(size) if number not in taken}
    known = [{"id": number, "content": text, "special": True} for text, number in marks.items()]
    flags = dict.fromkeys(("single_word", "lstrip", "rstrip", "normalized"), False)
    split = {"type": "Split", "pattern": {"Regex": "."}, "behavior": "Isolated", "invert": False}
    words = {"type": "WordLevel", "vocab": {**letters, **marks}, "unk_token": "?"}
    tokenizer: dict[str, Any] = {"version": "1.0", "added_tokens": [{**mark, **flags} for mark in known]}
    tokenizer |= {"pre_tokenizer": split, "model": words}
    tokenizer |= dict.fromkeys(("truncation", "padding", "normalizer", "post_processor", "decoder"))
    write_json(folder / "tokenizer.json", tokenizer)


def _weight(name: str, shape: torch.Size, draw: torch.Generator) -> torch.Tensor:
    """As ``random_weight``; of the language model in bf16, as released ones are."""
    if name.endswith((".times", ".places")):
        count, width = shape[1:]
        angles = torch.arange(count)[:, None] * torch.exp(torch.arange(0, width, 2) * (-math.log(10000.0) / width))
        return torch.stack([angles.sin(), angles.cos()], -1).reshape(shape)
    drawn = torch.full(shape, 0.1) if "lambda" in name else random_weight(name, shape, draw)
    return drawn.bfloat16() if name.startswith("embedder.") else drawn
