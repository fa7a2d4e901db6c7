"""Qwen2.5-VL inside a LeRobot policy: its sizes, its weights, and how images come to it."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from ttscompile.frontends.settings import Settings

from ..networks.language_layers import LanguageConfig
from ..networks.qwen25_vl import Piece, Qwen25VLConfig
from . import vla
from .config import MOST, MOST_LAYERS, MOST_VOCABULARY
from .qwen3_vl import image_processor

MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Of the colours that the vision transformer was trained on, in 0..1."""
KIND = "qwen2_5_vl"


def read_qwen25(model: Settings) -> Qwen25VLConfig:
    """Of the entries of its ``config.json``, for no image yet; defaults are those of transformers."""
    image, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    rope = vla.rope_of(text, 1e6)
    image.require(in_channels=3, out_hidden_size=text.values.get("hidden_size"), hidden_act="silu")
    text.require(hidden_act="silu", use_sliding_window=False)
    rope.choice("rope_type" if "rope_type" in rope.values else "type", "default", "mrope")
    depth, sections = image.number("depth", 32, MOST_LAYERS), rope.values.get("mrope_section")
    whole = image.values.get("fullatt_block_indexes", [7, 15, 23, 31])
    given = "fullatt_block_indexes" in image.values
    if not isinstance(whole, list) or (given and not set(map(repr, whole)) <= set(map(repr, range(depth)))):
        raise image.refusal("fullatt_block_indexes", f"numbers of layers, from 0 to {depth - 1}")
    if not isinstance(sections, list) or [type(one) for one in sections] != [int] * 3 or min(sections) < 0:
        raise rope.refusal("mrope_section", "three whole numbers")
    width, heads = image.number("hidden_size", 3584, MOST), image.number("num_heads", 16, MOST)
    patch, merge = image.number("patch_size", 14, MOST), image.number("spatial_merge_size", 2, MOST)
    side = image.number("window_size", 112, MOST)
    window = side // merge // patch
    if width % heads or width // heads % 4 or not window:
        expected = "heads of a multiple of 4 channels, and windows of a token at least"
        raise image.error(f"hidden_size is {width}, num_heads {heads} and window_size {side}; expected {expected}")
    inside = image.number("intermediate_size", 3420, MOST)
    tower = LanguageConfig(width, inside, depth, heads, heads, width // heads, biased=True, whole=True)
    layers, many = text.number("num_hidden_layers", 80, MOST_LAYERS), text.number("num_attention_heads", 64, MOST)
    own = Settings({"hidden_size": 8192, "num_attention_heads": 64, **text.values}, text.where)
    language = replace(vla.read_language(own, layers, own.number("hidden_size", None, MOST) // many), biased=True)
    if sum(sections) * 2 != language.channels:
        raise rope.refusal("mrope_section", f"three numbers that are {language.channels // 2} together")
    return Qwen25VLConfig(
        vision=tower,
        patch=patch,
        merge=merge,
        window=window,
        whole=frozenset(whole),
        text=language,
        vocabulary=text.number("vocab_size", 152064, MOST_VOCABULARY),
        sections=(sections[0], sections[1], sections[2]),
        base=vla.positive_number(rope, "rope_theta", 1e6),
    )


def read_pictures(folder: Path, config: Qwen25VLConfig, model: Settings) -> Settings:
    """How the processor in this folder reads images. Raises unless they reach the vision transformer as it expects.

    Args:
        model: entries of the backbone's ``config.json``.
    """
    own = image_processor(folder, {"patch_size": 14, "merge_size": 2})
    frames = vla.part_of(model, "vision_config").number("temporal_patch_size", 2, MOST)
    own.require(patch_size=config.patch, merge_size=config.merge, temporal_patch_size=frames, rescale_factor=1 / 255)
    own.require(do_resize=True, do_rescale=True, do_normalize=True, resample=3)
    return own


def pieces(tokens: Sequence[int], image: int, state: int) -> list[Piece]:
    """A prompt's tokens in pieces: what is between the tokens that stand for an image and for the state, and these."""
    found = list[Piece]()
    for own, group in groupby(tokens, lambda token: {image: "image", state: "state"}.get(token, "")):
        words = tuple(group)
        found += [words] if not own else ["image" if own == "image" else "state"] * len(words)
    return found
