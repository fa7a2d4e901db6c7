"""The sizes of Florence-2, as transformers or Microsoft's code writes them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ttscompile.frontends.settings import Settings

from ..networks.clip import ACTIVATIONS, TowerConfig
from ..networks.florence import BartConfig, FlorenceConfig, Stage
from .config import MOST
from .vla import part_of, positive_number

_MOST_VOCABULARY = 2**20
_STAGES: Mapping[str, list[Any]] = {
    "embed_dim": [128, 256, 512, 1024],
    "num_heads": [4, 8, 16, 32],
    "depths": [1, 1, 9, 1],
    "num_groups": [4, 8, 16, 32],
    "patch_size": [7, 3, 3, 3],
    "patch_stride": [4, 2, 2, 2],
    "patch_padding": [3, 1, 1, 1],
    "patch_prenorm": [False, True, True, True],
}
"""What transformers takes for an entry that a file leaves out."""


def read_florence(model: Settings, size: tuple[int, int], colours: tuple[bool, ...]) -> FlorenceConfig:
    """Sizes and variant, as transformers or Microsoft's code writes them.

    Args:
        model: the entries.
        size: height and width of the images.
        colours: of each camera, whether pixels are normalised.
    """
    vision, text = _translated(part_of(model, "vision_config")), part_of(model, "text_config")
    text.choice("model_type", "florence2_language", "bart")
    width, heads = text.number("d_model", 1024, MOST), text.number("encoder_attention_heads", 16, MOST)
    layers, hidden = text.number("encoder_layers", 12, MOST), text.number("encoder_ffn_dim", 4096, MOST)
    if vision.number("projection_dim", 1024, MOST) != width:
        raise vision.refusal("projection_dim", f"text_config.d_model, {width}", 1024)
    config = FlorenceConfig(
        stages=_stages(vision),
        text=BartConfig(
            *(width, hidden, layers, heads, text.choice("activation_function", "gelu", *ACTIVATIONS)),
            vocab_size=text.number("vocab_size", 50265, _MOST_VOCABULARY),
            max_position_embeddings=text.number("max_position_embeddings", 1024, MOST),
            scaled=text.flag("scale_embedding", False),
        ),
        window=vision.number("window_size", 12, MOST),
        positions=vision.number("max_position_embeddings", 50, MOST),
        moments=vision.number("max_temporal_embeddings", 100, MOST),
        size=size,
        colours=colours,
    )
    if not 1 <= min(config.grid) <= max(config.grid) <= config.positions:
        found = f"images of {list(size)} become {list(config.grid)} patches"
        raise vision.error(f"{found}; expected 1-{config.positions} along a side (max_position_embeddings)")
    return config


def _translated(vision: Settings) -> Settings:
    """The entries of the image encoder as transformers names them."""
    vision.choice("model_type", "davit", "florence_vision")
    entries = dict(vision.values)
    for name, kind, old, new in (
        ("image_pos_embed", "learned_abs_2d", "max_pos_embeddings", "max_position_embeddings"),
        ("visual_temporal_embedding", "COSINE", "max_temporal_embeddings", "max_temporal_embeddings"),
    ):
        inner = entries.get(name)
        if inner is not None and (not isinstance(inner, dict) or inner.get("type") != kind or old not in inner):
            raise vision.refusal(name, f"the type {kind}, with {old}")
        entries |= {} if inner is None else {new: inner[old]}
    if entries.get("image_feature_source") not in (None, ["spatial_avg_pool", "temporal_avg_pool"]):
        raise vision.refusal("image_feature_source", "spatial_avg_pool, temporal_avg_pool")
    return replace(vision, values=entries | ({"embed_dim": entries["dim_embed"]} if "dim_embed" in entries else {}))


def _stages(vision: Settings) -> tuple[Stage, ...]:
    """Of the image encoder."""
    if vision.number("in_channels", 3) != 3:
        raise vision.refusal("in_channels", "3")
    found = {name: vision.values.get(name, default) for name, default in _STAGES.items()}
    count = len(found["embed_dim"]) if isinstance(found["embed_dim"], list) else 0
    for name, value in found.items():
        kind, least = (bool, False) if name == "patch_prenorm" else (int, name != "patch_padding")
        fits = isinstance(value, list) and all(type(one) is kind and least <= one <= MOST for one in value)
        if not fits or len(value) != count or not count:
            raise vision.refusal(name, f"{count or 'some'} sizes, one for each stage (embed_dim)", _STAGES[name])
    ratio = positive_number(vision, "mlp_ratio", 4.0)
    activation, stages = vision.choice("activation_function", "gelu", *ACTIVATIONS), []
    for width, heads, layers, groups, *patches in zip(*found.values(), strict=True):
        between, own = (TowerConfig(width, int(width * ratio), layers, n, activation) for n in (groups, heads))
        stages.append(Stage(own, between.num_attention_heads, *patches))
    return tuple(stages)
