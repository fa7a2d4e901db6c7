"""Qwen3-VL inside a LeRobot policy: its folder, which lerobot needs, too, and its weights."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from ttscompile.errors import CheckpointError
from ttscompile.frontends.settings import Settings, read_json

from ..instruction import language_model_folder
from ..networks.clip import ACTIVATIONS
from ..networks.qwen3_vl import Qwen3VLConfig, QwenVisionConfig
from . import vla
from .config import CONFIG, MOST, MOST_LAYERS, MOST_VOCABULARY

TURN, IMAGE, END = "<|im_start|>user", "<|vision_start|><|image_pad|><|vision_end|>", "<|im_end|>"
"""What the chat template of Qwen3-VL writes; of an image's tokens one stands for all."""
Rebuilt = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
DIT_LAYERS = (
    (r"\.timestep_embedder\.", "."),
    (r"\.attn1\.to_([qkv])\.", r".attn1.\1_proj."),
    (r"\.attn1\.to_out\.0\.", ".attn1.out_proj."),
    (r"\.ff\.net\.0\.proj\.", ".ff.fc1."),
    (r"\.ff\.net\.2\.", ".ff.fc2."),
    (r"\.norm1\.linear\.", ".scale."),
)
"""Layers of a head that looks at what Qwen3-VL gives, as diffusers names them, to those of ``groot``."""


class Backbone(NamedTuple):
    """A Qwen3-VL on this machine: its folder and the entries of its ``config.json``."""

    folder: Path
    model: Settings

    @property
    def image(self) -> int:
        """The token that stands for an image."""
        return self.model.number("image_token_id", 151655, MOST_VOCABULARY)


class Resizing(NamedTuple):
    """How Qwen3-VL's processor resizes an image: to multiples along a side, and so many pixels in all."""

    multiple: int
    least: int
    most: int

    def __call__(self, height: int, width: int) -> tuple[int, int]:
        """Height and width afterwards."""
        own, pixels = self.multiple, height * width
        made = [round(side / own) * own for side in (height, width)]
        if math.prod(made) > self.most:
            share = math.sqrt(pixels / self.most)
            made = [max(own, math.floor(side / share / own) * own) for side in (height, width)]
        elif math.prod(made) < self.least:
            share = math.sqrt(self.least / pixels)
            made = [math.ceil(side * share / own) * own for side in (height, width)]
        return made[0], made[1]


def find_backbone(name: str, folders: list[Path]) -> Backbone:
    """The Qwen3-VL of this name."""
    folder = language_model_folder(name, folders, "qwen3_vl", "backbone")
    return Backbone(folder, Settings(read_json(folder / CONFIG), f"{folder / CONFIG}: "))


def read_resizing(backbone: Backbone) -> Resizing:
    """How images come to the backbone. Raises unless they and words do so as is rebuilt here."""
    folder, model = backbone
    vision, half = vla.part_of(model, "vision_config"), [0.5] * 3
    patch, merge = vision.number("patch_size", 16, MOST), vision.number("spatial_merge_size", 2, MOST)
    own = image_processor(folder, {"patch_size": None, "merge_size": None})
    own.require(patch_size=patch, merge_size=merge, image_mean=half, image_std=half, do_normalize=True, do_rescale=True)
    own.require(do_resize=True, resample=3, min_pixels=None, max_pixels=None)
    require_template(folder, "helpful assist")
    size = vla.part_of(own, "size")
    return Resizing(patch * merge, *(size.number(f"{entry}_edge", most=2**31) for entry in ("shortest", "longest")))


def image_processor(folder: Path, defaults: Mapping[str, int | None]) -> Settings:
    """Entries of the image processor in a folder; transformers prefers the file of the whole processor."""
    path = folder / "processor_config.json"
    found = read_json(path).get("image_processor") if path.is_file() else None
    if not isinstance(found, dict):
        found = read_json(path := folder / "preprocessor_config.json")
    return Settings({**defaults, **found}, f"{path}: ")


def require_template(folder: Path, own: str) -> None:
    """Raise unless the folder's chat template, if it has one, writes prompts as is rebuilt here, without ``own``."""
    path, beside = folder / "chat_template.jinja", folder / "tokenizer_config.json"
    entry = read_json(beside).get("chat_template") if beside.is_file() else None
    template = path.read_text("utf-8", "replace")[:MOST_VOCABULARY] if path.is_file() else entry
    wanted, told = ("<|im_start|>", IMAGE, END), str(template)
    if template is not None and (not all(word in told for word in wanted) or (own and own in told)):
        expected = f"Qwen's: {' '.join(wanted)}{own and ', and no words of its own'}"
        raise CheckpointError(f"{folder}: its chat template is another one than is rebuilt here; expected {expected}.")


def read_language(model: Settings, layers: int, images: list[tuple[int, int]]) -> Qwen3VLConfig:
    """Of the backbone's entries; defaults are those of transformers.

    Args:
        layers: of the language model that are used, at most.
        images: height and width of each camera's, as the backbone sees them.
    """
    image, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    rope = vla.rope_of(text, 5e5)
    image.require(in_channels=3, out_hidden_size=text.values.get("hidden_size"))
    text.require(hidden_act="silu", attention_bias=False)
    rope.require(rope_type="default", mrope_interleaved=True)
    depth, table = image.number("depth", 27, MOST_LAYERS), image.number("num_position_embeddings", 2304, 2**22)
    stacked, sections = image.values.get("deepstack_visual_indexes", [8, 16, 24]), rope.values.get("mrope_section")
    if not isinstance(stacked, list) or len(set(map(str, stacked)) & set(map(str, range(depth)))) < len(stacked):
        raise image.refusal("deepstack_visual_indexes", f"different layers, from 0 to {depth - 1}")
    sections = [24, 20, 20] if sections is None else sections
    if not isinstance(sections, list) or [type(one) for one in sections] != [int] * 3 or min(sections) < 0:
        raise rope.refusal("mrope_section", "three whole numbers")
    if math.isqrt(table) ** 2 != table:
        raise image.refusal("num_position_embeddings", "a square")
    vision = QwenVisionConfig(
        hidden_size=image.number("hidden_size", 1152),
        intermediate_size=image.number("intermediate_size", 4304),
        num_hidden_layers=depth,
        num_attention_heads=image.number("num_heads", 16),
        hidden_act=image.choice("hidden_act", "gelu_pytorch_tanh", *ACTIVATIONS),
        patch_size=image.number("patch_size", 16),
        merge=image.number("spatial_merge_size", 2, MOST),
        table=math.isqrt(table),
        stacked=tuple(stacked),
    )
    if vision.hidden_size // vision.num_attention_heads % 4:
        raise image.refusal("num_heads", "heads of a multiple of 4 channels")
    layers = min(text.number("num_hidden_layers", 32, MOST_LAYERS), layers)
    return Qwen3VLConfig(
        vision=vision,
        text=replace(vla.read_language(text, layers, 128), normed=True),
        vocabulary=text.number("vocab_size", 151936, MOST_VOCABULARY),
        sections=(sections[1], sections[2]),
        base=vla.positive_number(rope, "rope_theta", 5e5),
        grids=tuple((height // vision.patch_size, width // vision.patch_size) for height, width in images),
    )


def of_backbone(weights: Mapping[str, Tensor], inner: str, rebuilt: Rebuilt) -> tuple[dict[str, Tensor], ...]:
    """The weights that are not the backbone's, under their names; and the backbone's under those that it has here.

    Args:
        inner: how the names of the backbone's begin.
        rebuilt: makes these of those of transformers' model without its head.
    """
    others = {name: value for name, value in weights.items() if not name.startswith(inner)}
    own = {name.removeprefix(f"{inner}model."): value for name, value in weights.items() if name not in others}
    tied = own.pop(f"{inner}lm_head.weight", None)  # the numbers of the embedding, of which a file may have either
    if tied is not None:
        own.setdefault("language_model.embed_tokens.weight", tied)
    return others, {f"backbone.{name}": value for name, value in rebuilt(own).items()}
