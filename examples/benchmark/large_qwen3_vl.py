"""Qwen3-VL at the size of its 2B model, for ``large.py``: its folder, and the names and sizes of its weights."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from large_evo1 import save_letters
from large_smolvla import write_json

Shapes = Iterator[tuple[str, torch.Size]]
_FIRST_MARK, IMAGE_TOKEN, _LAST_MARK = 151643, 151655, 151668
_MARKS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>")
WORDS, _SEEN, _IMAGES, _MERGED = 2048, 24, 1024, 4096
"""Width of the language model; of the image encoder, layers, width, and that of four patches."""

MODEL: dict[str, Any] = {
    "model_type": "qwen3_vl",
    "image_token_id": IMAGE_TOKEN,
    "text_config": {
        "hidden_size": WORDS,
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
        "out_hidden_size": WORDS,
        "deepstack_visual_indexes": [5, 11, 17],
    },
}
"""Of Qwen3-VL-2B, and of Cosmos-Reason2-2B; other entries are the defaults."""


def save_backbone(folder: Path) -> None:
    """What a policy reads of its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "config.json", MODEL)
    write_json(folder / "tokenizer_config.json", {})
    pixels = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "do_normalize": True, "do_rescale": True}
    sizes = {"size": {"longest_edge": 2**24, "shortest_edge": 2**16}, "do_resize": True, "resample": 3}
    write_json(folder / "preprocessor_config.json", {**pixels, **sizes, "patch_size": 16, "merge_size": 2})
    marks = {mark: _FIRST_MARK + i for i, mark in enumerate(_MARKS)}
    save_letters(folder, marks | {"<|image_pad|>": IMAGE_TOKEN, "</think>": _LAST_MARK})


def backbone(start: str, layers: int, head: str) -> Shapes:
    """Names and sizes of all weights, of so many layers of the language model; ``head`` has the embedding's numbers."""
    yield f"{start}{head}.weight", torch.Size((MODEL["text_config"]["vocab_size"], WORDS))
    yield from _language(f"{start}model.language_model.", layers)
    yield from _vision(f"{start}model.visual.")


def linear(name: str, before: int, after: int, bias: bool = True) -> Shapes:
    """Of a linear layer."""
    yield f"{name}.weight", torch.Size((after, before))
    if bias:
        yield f"{name}.bias", torch.Size((after,))


def norm(name: str, width: int, bias: bool = True) -> Shapes:
    """Of a normalisation."""
    yield f"{name}.weight", torch.Size((width,))
    if bias:
        yield f"{name}.bias", torch.Size((width,))


def _language(start: str, layers: int) -> Shapes:
    text = MODEL["text_config"]
    queries, keys = (text[f"num_{kind}_heads"] * text["head_dim"] for kind in ("attention", "key_value"))
    for own in (f"{start}layers.{i}." for i in range(layers)):
        for name, size in {"q_proj": queries, "k_proj": keys, "v_proj": keys}.items():
            yield from linear(f"{own}self_attn.{name}", WORDS, size, bias=False)
        yield from linear(f"{own}self_attn.o_proj", queries, WORDS, bias=False)
        for name in ("q_norm", "k_norm"):
            yield from norm(f"{own}self_attn.{name}", text["head_dim"], bias=False)
        for name in ("gate_proj", "up_proj"):
            yield from linear(f"{own}mlp.{name}", WORDS, text["intermediate_size"], bias=False)
        yield from linear(f"{own}mlp.down_proj", text["intermediate_size"], WORDS, bias=False)
        for name in ("input_layernorm", "post_attention_layernorm"):
            yield from norm(f"{own}{name}", WORDS, bias=False)
    yield from norm(f"{start}norm", WORDS, bias=False)


def _vision(start: str) -> Shapes:
    inside = MODEL["vision_config"]["intermediate_size"]
    yield f"{start}patch_embed.proj.weight", torch.Size((_IMAGES, 3, 2, 16, 16))
    yield f"{start}patch_embed.proj.bias", torch.Size((_IMAGES,))
    yield f"{start}pos_embed.weight", torch.Size((MODEL["vision_config"]["num_position_embeddings"], _IMAGES))
    for own in (f"{start}blocks.{i}." for i in range(_SEEN)):
        yield from linear(f"{own}attn.qkv", _IMAGES, 3 * _IMAGES)
        yield from linear(f"{own}attn.proj", _IMAGES, _IMAGES)
        yield from linear(f"{own}mlp.linear_fc1", _IMAGES, inside)
        yield from linear(f"{own}mlp.linear_fc2", inside, _IMAGES)
        for name in ("norm1", "norm2"):
            yield from norm(f"{own}{name}", _IMAGES)
    stacked = [f"deepstack_merger_list.{i}" for i in range(len(MODEL["vision_config"]["deepstack_visual_indexes"]))]
    for own in ("merger", *stacked):
        yield from norm(f"{start}{own}.norm", _IMAGES if own == "merger" else _MERGED)
        yield from linear(f"{start}{own}.linear_fc1", _MERGED, _MERGED)
        yield from linear(f"{start}{own}.linear_fc2", _MERGED, WORDS)


def layer(own: str, width: int, source: int) -> Shapes:
    """Of a layer of attention and feed-forward, as diffusers names them."""
    for name, before in {"to_q": width, "to_k": source, "to_v": source, "to_out.0": width}.items():
        yield from linear(f"{own}attn1.{name}", before, width)
    yield from linear(f"{own}ff.net.0.proj", width, 4 * width)
    yield from linear(f"{own}ff.net.2", 4 * width, width)


def looking(start: str, width: int, layers: int, out: int) -> Shapes:
    """Of a head that looks at what the language model gives, at every second layer."""
    for i in range(layers):
        own = f"{start}transformer_blocks.{i}."
        yield from layer(own, width, width if i % 2 else WORDS)
        yield from linear(f"{own}norm1.linear", width, 2 * width)
    for name, before in {"1": 256, "2": width}.items():
        yield from linear(f"{start}timestep_encoder.timestep_embedder.linear_{name}", before, width)
    yield from linear(f"{start}proj_out_1", width, 2 * width)
    yield from linear(f"{start}proj_out_2", width, out)
