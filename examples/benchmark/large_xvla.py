"""X-VLA at its real size with random weights, for ``large.py``: Florence-2-large, and 24 layers of width 1024."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json

from ttscompile.frontends.settings import Settings
from ttscompile.policies.lerobot.florence import read_florence
from ttscompile.policies.networks.clip import TowerConfig
from ttscompile.policies.networks.xvla import XVLA, XVLAConfig

FLORENCE: dict[str, Any] = {
    "vision_config": {
        "embed_dim": [256, 512, 1024, 2048],
        "num_heads": [8, 16, 32, 64],
        "num_groups": [8, 16, 32, 64],
        "projection_dim": 1024,
    },
    "text_config": {"model_type": "bart", "vocab_size": 51289},
}
"""Florence-2-large; other entries are the defaults."""
_SIDE, _WORDS, _ACTIONS, _CHUNK, _VIEWS = 224, 50, 20, 30, 3


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of an xvla with its default network, which is of one robot alone."""
    directory.mkdir(parents=True, exist_ok=True)
    features = {STATE: {"type": "STATE", "shape": [_ACTIONS]}, **{key: FEATURES[key] for key in CAMERAS}}
    entries = {
        "type": "xvla",
        "input_features": features,
        "output_features": {ACTION: {"type": "ACTION", "shape": [_ACTIONS]}},
        "resize_imgs_with_padding": [_SIDE, _SIDE],
        "florence_config": FLORENCE,
        "chunk_size": _CHUNK,
        "n_action_steps": _CHUNK,
        "num_image_views": _VIEWS,
        "num_domains": 1,
    }
    write_json(directory / "config.json", entries)
    words = {"tokenizer_name": "facebook/bart-large", "max_length": _WORDS, "padding": "max_length", "truncation": True}
    steps: dict[str, Any] = {
        "tokenizer_processor": words,
        "xvla_image_to_float": {},
        "xvla_imagenet_normalize": {"image_keys": None},
    }
    as_it_is = {"eps": 1e-8, "norm_map": dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")}
    steps["normalizer_processor"] = as_it_is | {"features": features}
    after = {"unnormalizer_processor": as_it_is | {"features": entries["output_features"]}}
    for name, own in (("pre", steps), ("post", after)):
        made = [{"registry_name": step, "config": config} for step, config in own.items()]
        write_json(directory / f"policy_{name}processor.json", {"steps": made})
    layers = TowerConfig(1024, 4096, 24, 16, "gelu_pytorch_tanh")
    florence = read_florence(Settings(FLORENCE, ""), (_SIDE, _SIDE), (True,) * _VIEWS)
    numbers = {"state": 32, "time": 32, "prompts": 32, "positions": 512, "views": _VIEWS, "padding": 1}
    with torch.device("meta"):
        weights = XVLA(XVLAConfig(florence, layers, _CHUNK, _ACTIONS, (9, 19), **numbers)).state_dict()
    save_drawn(directory / "model.safetensors", {f"model.{name}": value.shape for name, value in weights.items()})
