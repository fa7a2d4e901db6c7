"""VLA-JEPA at its real size with random weights, for ``large.py``: what a robot needs of what lerobot saves."""

from __future__ import annotations

from pathlib import Path

import torch
from large_qwen3_vl import MODEL, Shapes, backbone, linear, looking, save_backbone
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json, write_processors

BACKBONE = "Qwen3-VL-2B-Instruct"
_BACKBONE = "model.qwen.model."
_HORIZON, _NUMBERS, _STEPS = 7, 6, 4
"""Actions of a chunk, numbers of an action and of the state, steps of a call."""
_HEAD, _LAYERS, _INSIDE, _ANSWERS = 768, 16, 1024, 32
"""Of the head: its width, its layers, width of what gives the actions, tokens of its own."""
_SIZES = {
    "chunk_size": _HORIZON,
    "n_action_steps": _HORIZON,
    "action_dim": _NUMBERS,
    "state_dim": _NUMBERS,
    "num_inference_timesteps": _STEPS,
    "num_embodied_action_tokens_per_instruction": _ANSWERS,
    "action_hidden_size": _INSIDE,
    "action_num_layers": _LAYERS,
}
"""Lerobot's own, which a saved configuration has, and other programs read."""


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of a vla_jepa with its default configuration, but for its world model.

    Pictures have 256 pixels along a side. The language model is in bf16, as lerobot has it.
    """
    directory.mkdir(parents=True, exist_ok=True)
    save_backbone(directory.parent / BACKBONE)
    features = FEATURES | {key: {"type": "VISUAL", "shape": [3, 256, 256]} for key in CAMERAS}
    entries = {
        "type": "vla_jepa",
        "input_features": {key: features[key] for key in (STATE, *CAMERAS)},
        "output_features": {ACTION: features[ACTION]},
        "qwen_model_name": f"Qwen/{BACKBONE}",
        **_SIZES,
    }
    write_json(directory / "config.json", entries)
    write_processors(directory, features)
    shapes = dict(backbone(_BACKBONE, MODEL["text_config"]["num_hidden_layers"], "model.language_model.embed_tokens"))
    shapes |= dict(_head("model.action_model."))
    save_drawn(directory / "model.safetensors", shapes, halved=_BACKBONE)


def _head(start: str) -> Shapes:
    layers = {
        "state_encoder.layer1": (_NUMBERS, _INSIDE),
        "state_encoder.layer2": (_INSIDE, _HEAD),
        "action_encoder.layer1": (_NUMBERS, _HEAD),
        "action_encoder.layer2": (2 * _HEAD, _HEAD),
        "action_encoder.layer3": (_HEAD, _HEAD),
        "action_decoder.layer1": (_INSIDE, _INSIDE),
        "action_decoder.layer2": (_INSIDE, _NUMBERS),
    }
    for name, (before, after) in layers.items():
        yield from linear(f"{start}{name}", before, after)
    for name, rows in {"position_embedding": 1024, "future_tokens": _ANSWERS}.items():
        yield f"{start}{name}.weight", torch.Size((rows, _HEAD))
    yield from looking(f"{start}model.", _HEAD, _LAYERS, _INSIDE)
