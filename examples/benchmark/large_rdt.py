"""RDT-170M at its real size with random weights, for ``large.py``: 14 layers of width 1024, tokens of three cameras."""

from __future__ import annotations

from pathlib import Path

import torch
from large_smolvla import random_weight, write_json

from ttscompile.frontends.settings import Settings
from ttscompile.policies.rdt import CONFIG, PICKLED, RDTHead, read_config

ENTRIES = {
    "action_dim": 128,
    "img_adaptor": "mlp2x_gelu",
    "img_cond_len": 4374,
    "img_token_dim": 1152,
    "lang_adaptor": "mlp2x_gelu",
    "lang_token_dim": 4096,
    "max_lang_cond_len": 1024,
    "noise_scheduler": {
        "beta_schedule": "squaredcos_cap_v2",
        "clip_sample": False,
        "num_inference_timesteps": 5,
        "num_train_timesteps": 1000,
        "prediction_type": "sample",
        "type": "ddpm",
    },
    "pred_horizon": 64,
    "rdt": {"cond_pos_embed_type": "multimodal", "depth": 14, "hidden_size": 1024, "num_heads": 32},
    "state_adaptor": "mlp3x_gelu",
    "state_token_dim": 128,
}


def save(directory: Path) -> None:
    """What RDT's ``save_pretrained`` writes."""
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / CONFIG, ENTRIES)
    with torch.device("meta"):
        shapes = RDTHead(read_config(Settings(ENTRIES, ""))).state_dict()
    draw = torch.Generator().manual_seed(0)
    weights = {name: random_weight(name, value.shape, draw) for name, value in shapes.items()}
    torch.save(weights, directory / PICKLED)
