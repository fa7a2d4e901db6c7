"""EO-1 at its real size with random weights, for ``large.py``: the checkpoint, and its backbone's files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from large_evo1 import save_letters
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json, write_processors

from ttscompile.frontends.families import AS_SAVED
from ttscompile.frontends.settings import Settings, read_json
from ttscompile.policies.lerobot.eo1 import read_config
from ttscompile.policies.lerobot.processors import CONVERSATION, READ
from ttscompile.policies.lerobot.qwen25_vl import DEVIATION, MEAN, read_qwen25
from ttscompile.policies.lerobot.vla import read_vla_config
from ttscompile.policies.networks.eo1 import EO1

BACKBONE = "Qwen2.5-VL-3B-Instruct"
_MARKS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>")
_IMAGE = {"<|vision_start|>": 151652, "<|vision_end|>": 151653, "<|image_pad|>": 151655, "</tool_call>": 151664}
MODEL: dict[str, Any] = {
    "model_type": "qwen2_5_vl",
    "image_token_id": _IMAGE["<|image_pad|>"],
    "text_config": {
        "hidden_size": 2048,
        "intermediate_size": 11008,
        "num_hidden_layers": 36,
        "num_attention_heads": 16,
        "num_key_value_heads": 2,
        "rms_norm_eps": 1e-6,
        "vocab_size": 151936,
        "rope_parameters": {"rope_theta": 1e6, "rope_type": "default", "mrope_section": [16, 24, 24]},
    },
    "vision_config": {"hidden_size": 1280, "out_hidden_size": 2048},
}
"""Qwen2.5-VL-3B; other entries are the defaults."""
_SIZES = {"chunk_size": 8, "n_action_steps": 8, "num_denoise_steps": 10, "max_state_dim": 32, "max_action_dim": 32}
"""Lerobot's own."""
_PIXELS = {"image_min_pixels": 64 * 28 * 28, "image_max_pixels": 128 * 28 * 28}


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of an eo1 with its default configuration, the backbone in bf16."""
    model = directory.parent / BACKBONE
    for each in (directory, model):
        each.mkdir(parents=True, exist_ok=True)
    write_json(model / "config.json", MODEL)
    colours = {"image_mean": list(MEAN), "image_std": list(DEVIATION), "patch_size": 14, "merge_size": 2}
    write_json(model / "preprocessor_config.json", colours)
    save_letters(model, {mark: 151643 + i for i, mark in enumerate(_MARKS)} | _IMAGE)
    features = {key: FEATURES[key] for key in (STATE, *CAMERAS)}
    entries = {
        "type": "eo1",
        "input_features": features,
        "output_features": {ACTION: FEATURES[ACTION]},
        "vlm_base": f"Qwen/{BACKBONE}",
        "vlm_config": MODEL,
        **_SIZES,
        **_PIXELS,
    }
    write_json(directory / "config.json", entries)
    write_processors(directory)
    path = directory / "policy_preprocessor.json"
    told = {CONVERSATION: {"input_features": features, "chunk_size": _SIZES["chunk_size"]}}
    told[READ] = {"processor_name": f"Qwen/{BACKBONE}", **_PIXELS}
    steps = [{"registry_name": name, "config": config} for name, config in told.items()]
    write_json(path, {"steps": [*read_json(path)["steps"], *steps]})
    shared = read_vla_config(directory, entries, AS_SAVED)
    with torch.device("meta"):
        weights = EO1(read_config(shared, read_qwen25(Settings(MODEL, ""))), ()).state_dict()
    shapes = {f"model.{name}".replace(".backbone.", ".vlm_backbone.model."): w.shape for name, w in weights.items()}
    save_drawn(directory / "model.safetensors", shapes, halved="model.vlm_backbone.")
