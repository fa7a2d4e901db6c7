"""Dita at its real size with random weights, for ``large.py``: two frames of one camera, and CLIP's text encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from large_smolvla import random_weight, write_json
from safetensors.torch import save_file

from ttscompile.policies.dita import CLIP, CONFIG
from ttscompile.policies.networks.clip import RELEASED, ClipText, TextConfig
from ttscompile.policies.networks.dita_head import DitaHead
from ttscompile.policies.networks.qformer import QFormer

CHECKPOINT = Path("checkpoints") / "ckpt.pth"
SETTINGS = {"dataset": {"traj_length": 11}, "num_pred_action": 10, "num_inference_steps": 10}
"""Ten actions after those of two frames, as Dita was trained for LIBERO and CALVIN."""
SIDE, PATCH, REGISTERS = 16, 14, 4
"""Of a picture of 224 pixels: patches along a side, and pixels of one; and tokens beside."""
SIZES = {"width": 768, "heads": 12, "hidden": 2048, "layers": 12, "actions": 7}
LAYERS, QUERIES, MAKERS = 12, 32, 4
"""Of DINOv2; and tokens of a frame, and the layers that make them."""
TEXT: dict[str, Any] = dict(RELEASED[CLIP]["text_config"])


def save(directory: Path) -> None:
    """What a training of Dita writes, and the folder of CLIP beside it."""
    clip = directory / CLIP
    for folder in (directory / CONFIG, directory / CHECKPOINT, clip / "config.json"):
        folder.parent.mkdir(parents=True)
    write_json(directory / CONFIG, SETTINGS)  # JSON is YAML, too
    write_json(clip / "config.json", {"model_type": "clip", "text_config": TEXT})
    width = SIZES["width"]
    with torch.device("meta"):
        head = DitaHead(**SIZES).state_dict()
        maker = QFormer(width, MAKERS, QUERIES, frames=2).state_dict()
        text = ClipText(TextConfig(**TEXT)).state_dict()
    tower = {f"image_tokenizer.tokenizer.{name}": torch.Size(shape) for name, shape in tower_shapes(width).items()}
    shapes = {name: value.shape for name, value in head.items()} | tower
    shapes |= {f"image_tokenizer.qformer.{name}": value.shape for name, value in maker.items()}
    draw = torch.Generator().manual_seed(0)
    weights = {name: random_weight(name, shape, draw) for name, shape in shapes.items()}
    weights |= {name: torch.ones(shape) for name, shape in shapes.items() if name.endswith(".gamma")}
    torch.save({"parameter": weights}, directory / CHECKPOINT)
    words = {f"text_model.{name}": random_weight(name, value.shape, draw) for name, value in text.items()}
    save_file(words, clip / "model.safetensors")


def tower_shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Of the weights of timm's ``vit_base_patch14_reg4_dinov2``."""
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, width),
        "reg_token": (1, REGISTERS, width),
        "pos_embed": (1, SIDE**2, width),
        "patch_embed.proj.weight": (width, 3, PATCH, PATCH),
        "patch_embed.proj.bias": (width,),
    }
    linear = {"attn.qkv": (3, 1), "attn.proj": (1, 1), "mlp.fc1": (4, 1), "mlp.fc2": (1, 4)}
    for layer in range(LAYERS):
        own = f"blocks.{layer}"
        for name, (out, read) in linear.items():
            shapes |= {f"{own}.{name}.weight": (out * width, read * width), f"{own}.{name}.bias": (out * width,)}
        shapes |= {f"{own}.norm{i}.{name}": (width,) for i in (1, 2) for name in ("weight", "bias")}
        shapes |= {f"{own}.ls{i}.gamma": (width,) for i in (1, 2)}
    return shapes | {"norm.weight": (width,), "norm.bias": (width,)}
