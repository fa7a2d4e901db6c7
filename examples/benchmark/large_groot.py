"""GR00T N1.7 at its real size with random weights, for ``large.py``: what lerobot saves, and what it needs beside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from large_qwen3_vl import WORDS, Shapes, backbone, layer, looking, norm, save_backbone
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json
from safetensors.torch import save_file

BASE, BACKBONE = "GR00T-N1.7-3B", "Cosmos-Reason2-2B"
_PADDED, _HORIZON, _EMBODIMENTS, EMBODIMENT = 132, 40, 32, 10
_LAYERS, _HEAD, _HEAD_LAYERS, _INSIDE = 16, 1536, 32, 1024
"""Layers of the language model that are used; of the head, its width, its layers, and width of what gives actions."""

BASE_ENTRIES: dict[str, Any] = {
    "model_type": "Gr00tN1d7",
    "model_name": f"nvidia/{BACKBONE}",
    "select_layer": _LAYERS,
    "action_horizon": _HORIZON,
    "use_alternate_vl_dit": True,
    "attend_text_every_n_blocks": 2,
    "max_num_embodiments": _EMBODIMENTS,
    "diffusion_model_cfg": {
        "num_layers": _HEAD_LAYERS,
        "num_attention_heads": 32,
        "attention_head_dim": 48,
        "output_dim": _INSIDE,
        "interleave_self_attention": True,
        "positional_embeddings": None,
        "norm_type": "ada_norm",
    },
    "vl_self_attention_cfg": {
        "num_layers": 4,
        "num_attention_heads": 32,
        "attention_head_dim": 64,
        "positional_embeddings": None,
    },
}
"""Of the base model, as lerobot has them; what is not here is the default."""
_GEOMETRY = {"image_crop_size": [230, 230], "image_target_size": [256, 256]}


def save(directory: Path) -> None:
    """What lerobot's ``save_pretrained`` writes of a groot with its default configuration, in float32."""
    base = directory.parent / BASE
    for each in (directory, base):
        each.mkdir(parents=True, exist_ok=True)
    write_json(base / "config.json", BASE_ENTRIES)
    write_json(base / "processor_config.json", {"processor_kwargs": _GEOMETRY})
    write_json(base / "embodiment_id.json", {"new_embodiment": EMBODIMENT})
    save_backbone(directory.parent / BACKBONE)
    entries = {
        "type": "groot",
        "input_features": {key: FEATURES[key] for key in (STATE, *CAMERAS)},
        "output_features": {ACTION: FEATURES[ACTION]},
        "base_model_path": f"nvidia/{BASE}",
        "chunk_size": _HORIZON,
        "n_action_steps": _HORIZON,
    }
    write_json(directory / "config.json", entries)
    _write_processors(directory)
    save_drawn(directory / "model.safetensors", {f"_groot_model.{name}": size for name, size in _shapes()})


def _write_processors(directory: Path) -> None:
    """State and actions between -1 and 1 as they are."""
    bounds = {f"{key}.{end}": torch.full((6,), at) for key in (STATE, ACTION) for end, at in (("min", -1), ("max", 1))}
    save_file({name: value.float() for name, value in bounds.items()}, directory / "statistics.safetensors")
    sides = {"max_state_dim": _PADDED, "max_action_dim": _PADDED}
    robot = {"embodiment_tag": "new_embodiment", "embodiment_mapping": {"new_embodiment": EMBODIMENT}}
    pack = {"action_horizon": _HORIZON, "valid_action_horizon": _HORIZON, "normalize_min_max": True, **sides, **robot}
    encode = {"model_name": f"nvidia/{BACKBONE}", **_GEOMETRY}
    unpack = {"env_action_dim": FEATURES[ACTION]["shape"][0], "normalize_min_max": True}
    own = {"state_file": "statistics.safetensors"}
    before = [
        {"registry_name": "groot_n1_7_pack_inputs_v1", "config": pack, **own},
        {"registry_name": "groot_n1_7_vlm_encode_v1", "config": encode},
    ]
    after = {"registry_name": "groot_action_unpack_unnormalize_v2", "config": unpack, **own}
    write_json(directory / "policy_preprocessor.json", {"steps": before})
    write_json(directory / "policy_postprocessor.json", {"steps": [after]})


def _shapes() -> Shapes:
    """Names and sizes of all weights, of each embodiment's too, as lerobot saves them."""
    yield from backbone("backbone.model.", _LAYERS, "lm_head")
    yield from _head("action_head.")


def _head(start: str) -> Shapes:
    of_each = {
        "state_encoder.layer1": (_PADDED, _INSIDE),
        "state_encoder.layer2": (_INSIDE, _HEAD),
        "action_encoder.W1": (_PADDED, _HEAD),
        "action_encoder.W2": (2 * _HEAD, _HEAD),
        "action_encoder.W3": (_HEAD, _HEAD),
        "action_decoder.layer1": (_INSIDE, _INSIDE),
        "action_decoder.layer2": (_INSIDE, _PADDED),
    }
    for name, (before, after) in of_each.items():
        yield f"{start}{name}.W", torch.Size((_EMBODIMENTS, before, after))
        yield f"{start}{name}.b", torch.Size((_EMBODIMENTS, after))
    yield f"{start}position_embedding.weight", torch.Size((1024, _HEAD))
    yield from norm(f"{start}vlln", WORDS)
    for own in (f"{start}vl_self_attention.transformer_blocks.{i}." for i in range(4)):
        yield from layer(own, WORDS, WORDS)
        for name in ("norm1", "norm3"):
            yield from norm(f"{own}{name}", WORDS)
    yield from looking(f"{start}model.", _HEAD, _HEAD_LAYERS, _INSIDE)
