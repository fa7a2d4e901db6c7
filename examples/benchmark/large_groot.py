"""GR00T N1.7 at its real size with random weights, for ``large.py``: what lerobot saves, and what it needs beside."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from large_evo1 import save_letters
from large_smolvla import ACTION, CAMERAS, FEATURES, STATE, save_drawn, write_json
from safetensors.torch import save_file

Shapes = Iterator[tuple[str, torch.Size]]
BASE, BACKBONE = "GR00T-N1.7-3B", "Cosmos-Reason2-2B"
_MARKS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>")
_FIRST_MARK, IMAGE_TOKEN = 151643, 151655
_PADDED, _HORIZON, _EMBODIMENTS, EMBODIMENT = 132, 40, 32, 10
_LAYERS, _WORDS, _SEEN, _IMAGES, _MERGED = 16, 2048, 24, 1024, 4096
"""Layers of the language model that are used, its width; of the image encoder, its width, and that of four patches."""
_HEAD, _HEAD_LAYERS, _INSIDE = 1536, 32, 1024

MODEL: dict[str, Any] = {
    "model_type": "qwen3_vl",
    "image_token_id": IMAGE_TOKEN,
    "text_config": {
        "hidden_size": _WORDS,
        "intermediate_size": 6144,
        "num_hidden_layers": 28,
        "num_attention_heads": 16,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
        "rope_theta": 5e6,
        "rope_scaling": {"mrope_section": [24, 20, 20], "rope_type": "default", "mrope_interleaved": True},
    },
    "vision_config": {
        "depth": _SEEN,
        "hidden_size": _IMAGES,
        "intermediate_size": 4096,
        "num_heads": 16,
        "num_position_embeddings": 2304,
        "out_hidden_size": _WORDS,
        "deepstack_visual_indexes": [5, 11, 17],
    },
}
"""Cosmos-Reason2-2B, a Qwen3-VL; other entries are the defaults."""
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
    base, model = directory.parent / BASE, directory.parent / BACKBONE
    for each in (directory, base, model):
        each.mkdir(parents=True, exist_ok=True)
    write_json(base / "config.json", BASE_ENTRIES)
    write_json(base / "processor_config.json", {"processor_kwargs": _GEOMETRY})
    write_json(base / "embodiment_id.json", {"new_embodiment": EMBODIMENT})
    write_json(model / "config.json", MODEL)
    write_json(model / "tokenizer_config.json", {})
    pixels = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "do_normalize": True, "do_rescale": True}
    sizes = {"size": {"longest_edge": 2**24, "shortest_edge": 2**16}, "do_resize": True, "resample": 3}
    write_json(model / "preprocessor_config.json", {**pixels, **sizes, "patch_size": 16, "merge_size": 2})
    save_letters(model, {mark: _FIRST_MARK + i for i, mark in enumerate(_MARKS[:-1])} | {_MARKS[-1]: IMAGE_TOKEN})
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
    yield "backbone.model.lm_head.weight", torch.Size((MODEL["text_config"]["vocab_size"], _WORDS))  # and embedding
    yield from _language("backbone.model.model.language_model.")
    yield from _vision("backbone.model.model.visual.")
    yield from _head("action_head.")


def _linear(name: str, before: int, after: int, bias: bool = True) -> Shapes:
    yield f"{name}.weight", torch.Size((after, before))
    if bias:
        yield f"{name}.bias", torch.Size((after,))


def _norm(name: str, width: int, bias: bool = True) -> Shapes:
    yield f"{name}.weight", torch.Size((width,))
    if bias:
        yield f"{name}.bias", torch.Size((width,))


def _language(start: str) -> Shapes:
    text = MODEL["text_config"]
    queries, keys = (text[f"num_{kind}_heads"] * text["head_dim"] for kind in ("attention", "key_value"))
    for own in (f"{start}layers.{i}." for i in range(_LAYERS)):
        for name, size in {"q_proj": queries, "k_proj": keys, "v_proj": keys}.items():
            yield from _linear(f"{own}self_attn.{name}", _WORDS, size, bias=False)
        yield from _linear(f"{own}self_attn.o_proj", queries, _WORDS, bias=False)
        for name in ("q_norm", "k_norm"):
            yield from _norm(f"{own}self_attn.{name}", text["head_dim"], bias=False)
        for name in ("gate_proj", "up_proj"):
            yield from _linear(f"{own}mlp.{name}", _WORDS, text["intermediate_size"], bias=False)
        yield from _linear(f"{own}mlp.down_proj", text["intermediate_size"], _WORDS, bias=False)
        for name in ("input_layernorm", "post_attention_layernorm"):
            yield from _norm(f"{own}{name}", _WORDS, bias=False)
    yield from _norm(f"{start}norm", _WORDS, bias=False)


def _vision(start: str) -> Shapes:
    inside = MODEL["vision_config"]["intermediate_size"]
    yield f"{start}patch_embed.proj.weight", torch.Size((_IMAGES, 3, 2, 16, 16))
    yield f"{start}patch_embed.proj.bias", torch.Size((_IMAGES,))
    yield f"{start}pos_embed.weight", torch.Size((MODEL["vision_config"]["num_position_embeddings"], _IMAGES))
    for own in (f"{start}blocks.{i}." for i in range(_SEEN)):
        yield from _linear(f"{own}attn.qkv", _IMAGES, 3 * _IMAGES)
        yield from _linear(f"{own}attn.proj", _IMAGES, _IMAGES)
        yield from _linear(f"{own}mlp.linear_fc1", _IMAGES, inside)
        yield from _linear(f"{own}mlp.linear_fc2", inside, _IMAGES)
        for name in ("norm1", "norm2"):
            yield from _norm(f"{own}{name}", _IMAGES)
    stacked = [f"deepstack_merger_list.{i}" for i in range(len(MODEL["vision_config"]["deepstack_visual_indexes"]))]
    for own in ("merger", *stacked):
        yield from _norm(f"{start}{own}.norm", _IMAGES if own == "merger" else _MERGED)
        yield from _linear(f"{start}{own}.linear_fc1", _MERGED, _MERGED)
        yield from _linear(f"{start}{own}.linear_fc2", _MERGED, _WORDS)


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
    yield from _norm(f"{start}vlln", _WORDS)
    for own in (f"{start}vl_self_attention.transformer_blocks.{i}." for i in range(4)):
        yield from _layer(own, _WORDS, _WORDS)
        for name in ("norm1", "norm3"):
            yield from _norm(f"{own}{name}", _WORDS)
    for i in range(_HEAD_LAYERS):
        own = f"{start}model.transformer_blocks.{i}."
        yield from _layer(own, _HEAD, _HEAD if i % 2 else _WORDS)
        yield from _linear(f"{own}norm1.linear", _HEAD, 2 * _HEAD)
    for name, before in {"1": 256, "2": _HEAD}.items():
        yield from _linear(f"{start}model.timestep_encoder.timestep_embedder.linear_{name}", before, _HEAD)
    yield from _linear(f"{start}model.proj_out_1", _HEAD, 2 * _HEAD)
    yield from _linear(f"{start}model.proj_out_2", _HEAD, _INSIDE)


def _layer(own: str, width: int, source: int) -> Shapes:
    """As diffusers names them."""
    for name, before in {"to_q": width, "to_k": source, "to_v": source, "to_out.0": width}.items():
        yield from _linear(f"{own}attn1.{name}", before, width)
    yield from _linear(f"{own}ff.net.0.proj", width, 4 * width)
    yield from _linear(f"{own}ff.net.2", 4 * width, width)
