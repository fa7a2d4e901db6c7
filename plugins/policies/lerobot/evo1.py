"""LeRobot's ``evo1``: its directory to module and ``PolicySpec``; cameras, instruction and state to robot actions.

Neither lerobot nor transformers is needed. Sizes of the language model, InternVL3, and its tokenizer are those of its
folder, which lerobot needs, too. Source: ``Evo1Policy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ttscompile.core.spec import LARGEST, Affine, ChunkSpec, Instruction, PolicySpec, Switch
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled, renamed, separated
from ttscompile.frontends.settings import Settings, read_json

from ..instruction import encoder_folders, language_model_folder, task_tokens, told_after
from ..networks.clip import ACTIVATIONS
from ..networks.evo1 import TIMES, Denoiser, Evo1, Evo1Config, Prefix
from ..networks.internvl import InternVitConfig, InternVLConfig, Prompt
from . import vla
from .config import CONFIG, MOST, MOST_LAYERS, MOST_LETTERS, MOST_PIXELS, MOST_VOCABULARY, LeRobotConfig
from .policy import MASK, TOKENS, read_weights
from .processors import Processors

_MODEL = "OpenGVLab/InternVL3-1B-hf"
_MOST_VIEWS, _MOST_KINDS = 64, 4096
Rule = tuple[str, str]
"""A pattern in the name of a weight, and what it becomes."""
_IMAGE = "Image-{}: <img><IMG_CONTEXT></img>"
"""The line of one image in the prompt; of its tokens one stands for all, since none is joined to a word beside it."""
_EMBEDDER = (
    (r"^model\.", ""),
    (r"^embedder\.model\.", "embedder."),
    (r"\.patch_embeddings\.projection\.", ".projection."),
    (r"\.encoder\.layer\.", ".encoder.layers."),
    (r"\.attention\.projection_layer\.", ".self_attn.out_proj."),
    (r"\.attention\.", ".self_attn."),
    (r"\.layernorm_before\.", ".layer_norm1."),
    (r"\.layernorm_after\.", ".layer_norm2."),
)
_HEAD = (
    (r"\.action_encoder\.W1\.", ".action_encoder.first."),
    (r"\.action_encoder\.W2\.", ".action_encoder.second."),
    (r"\.action_encoder\.W3\.", ".action_encoder.third."),
    (r"\.action_encoder\.pos_encoding\.pe$", ".action_encoder.places"),
    (r"\.single_action_proj\.", ".action_encoder."),
    (r"\.time_pos_enc\.pe$", ".times"),
)
_SHARED = (r"\.linear\.(weight|bias)$", r".\1")
"""Where there is one embodiment."""
_BY_KIND = re.compile(r"\.(action_encoder\.(first|second|third)|(mlp_head|state_encoder)\.fc[12])\.(weight|bias)$")
"""Weights of the head that each embodiment may have of its own."""


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    shared, processors = vla.read_vla_processors(shared)
    settings = shared.settings
    name = settings.text("vlm_model_name", _MODEL, MOST_LETTERS)
    folder = language_model_folder(name, encoder_folders(options.encoders, directory), "internvl")
    model = Settings(read_json(folder / CONFIG), f"{folder / CONFIG}: ")
    config = read_config(shared, model)
    views = _views(settings)
    image = model.number("image_token_id", 151667, MOST_VOCABULARY)
    between, told, length, task = spoken(settings, config, name, folder, image, views, options.task)
    sizes = {"actions": config.max_action_dim, "tokens": length, "vocabulary": config.language.vocabulary}
    saved = read_weights(shared, options, *unread(config))
    weights = as_named(saved, settings, config, model, _EMBEDDER)
    prompt = Prompt(between, len(shared.cameras))
    network = filled(lambda: Evo1(config, prompt), weights, "config.json, or the language model's,", directory)
    encoder = vla.Gathered(shared, processors, Prefix(network), config.max_state_dim, task)
    side, table = config.language.vision.image_size, partial(vla.in_buckets, settings, 32, TIMES - 1, False)
    spec = vla.vla_spec(shared, processors, (side, side), "stretch", sizes, options, table, told)
    chunk = _chunk(settings, spec.chunk)
    chunk = replace(chunk, switches=_switches(settings, processors, chunk.action_dim))
    spec = replace(spec, chunk=chunk, noise="uniform")
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def read_config(shared: LeRobotConfig, model: Settings) -> Evo1Config:
    """Sizes and variant, of the policy's entries and those of its language model."""
    settings = shared.settings
    if str(settings.values.get("action_head", "flowmatching")).lower() != "flowmatching":
        raise settings.refusal("action_head", "flowmatching")
    language = _read_language(settings, model)
    resolution = settings.size("image_resolution", [448, 448], MOST_PIXELS) or (448, 448)
    vla.require_square(settings, "image_resolution", resolution, language.vision.patch_size * language.scale)
    if resolution[0] != language.vision.image_size:
        raise settings.refusal("image_resolution", f"the language model's image_size, {language.vision.image_size}")
    heads, width = settings.number("num_heads", 8, MOST), language.text.width
    if settings.number("embed_dim", 896, MOST) != width or width % heads or width % 2:
        raise settings.refusal("embed_dim", f"the language model's width, {width}, even, a multiple of {heads}", 896)
    return Evo1Config(
        language=language,
        chunk_size=shared.horizon,
        actions=shared.action_dim,
        max_action_dim=vla.padded_size(settings, "max_action_dim", shared.action_dim, 24),
        max_state_dim=vla.padded_size(settings, "max_state_dim", shared.state_dim, 24),
        hidden_dim=settings.number("hidden_dim", 1024, MOST),
        state_hidden_dim=settings.number("state_hidden_dim", 1024, MOST),
        num_heads=heads,
        num_layers=settings.number("num_layers", 8, MOST_LAYERS),
        return_cls_only=settings.flag("return_cls_only", False),
    )


def _read_language(settings: Settings, model: Settings) -> InternVLConfig:
    """Of the language model's entries; defaults are those of transformers."""
    image, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    image.require(norm_type="layer_norm", use_qk_norm=False, use_absolute_position_embeddings=True, num_channels=3)
    model.require(vision_feature_layer=-1, vision_feature_select_strategy="default")
    text.require(model_type="qwen2", hidden_act="silu", use_sliding_window=False)
    names = {field for field in InternVitConfig.__dataclass_fields__ if field in image.values}
    sizes = {name: _side(image, name) for name in names & {"image_size", "patch_size"}}
    vision = InternVitConfig(**{name: image.values[name] for name in names} | sizes)
    ratio = vla.positive_number(model, "downsample_ratio", 0.5)
    scale = max(int(1 / ratio), 1)
    if abs(scale * ratio - 1) > 1e-6 or vision.side % scale:
        raise model.refusal("downsample_ratio", f"one of so many of the {vision.side} patches along a side", 0.5)
    there, wanted = text.number("num_hidden_layers", 32, MOST_LAYERS), settings.values.get("vlm_num_layers", 14)
    if wanted is not None and type(wanted) is not int:
        raise settings.refusal("vlm_num_layers", "a whole number, or null for all", 14)
    heads = text.number("num_attention_heads", 32, MOST)
    language = vla.read_language(text, len(range(there)[:wanted]), text.number("hidden_size", 4096, MOST) // heads)
    language = replace(language, biased=True)
    config = InternVLConfig(
        vision=vision,
        text=language,
        vocabulary=text.number("vocab_size", 151936, MOST_VOCABULARY),
        scale=scale,
        activation=model.choice("projector_hidden_act", "gelu", *ACTIVATIONS),
        base=_rotary_base(text, settings.number("max_text_length", 1024, MOST)),
    )
    if model.number("image_seq_length", 256) != config.image_tokens:
        raise model.refusal("image_seq_length", f"{config.image_tokens}, of {vision.side} patches along a side", 256)
    return config


def _rotary_base(text: Settings, longest: int) -> float:
    """Of the rotary embedding; a dynamic one is another only where more words than in training are read."""
    rope = vla.rope_of(text, 10_000.0)
    name = "rope_type" if "rope_type" in rope.values else "type"
    if rope.choice(name, "default", "dynamic") == "dynamic":
        most = text.number("max_position_embeddings", 32768)
        if longest > most:
            raise text.refusal("max_position_embeddings", f"at least max_text_length, {longest}, with a dynamic one")
    rope.require(partial_rotary_factor=1)
    return vla.positive_number(rope, "rope_theta", 10_000.0)


def _side(image: Settings, name: str) -> int:
    """Pixels along a side, which the file has once or twice."""
    value = image.values[name]
    sides = value if isinstance(value, list) and len(value) == 2 else [value, value]
    if type(sides[0]) is not int or sides[0] != sides[1]:
        raise image.refusal(name, "a square")
    return sides[0]


def _views(settings: Settings) -> int:
    """Images of the prompt, those counted that the robot has none of."""
    views = settings.number("max_views", 3, _MOST_VIEWS)
    features = settings.values["input_features"].values()
    cameras = sum(feature.get("type") == "VISUAL" for feature in features)
    if cameras > views:
        raise settings.refusal("max_views", f"{cameras} at least, as many as there are cameras", 3)
    return views


def _switches(settings: Settings, processors: Processors, numbers: int) -> tuple[Switch, ...]:
    """The gripper, where one of two numbers stands for it."""
    if not settings.flag("binarize_gripper", False):
        return ()
    channel, told = settings.values.get("gripper_index", 6), list[float]()
    if type(channel) is not int or not 0 <= channel < numbers:
        raise settings.refusal("gripper_index", f"one of the {numbers} numbers of an action", 6)
    for name, default in (("threshold", 0.5), ("below_threshold_value", 1.0), ("above_threshold_value", -1.0)):
        value = settings.values.get(f"gripper_{name}", default)
        if type(value) not in (int, float) or not abs(value) < LARGEST:
            raise settings.refusal(f"gripper_{name}", "a number", default)
        told.append(float(value))
    return (vla.switch(processors, channel, *told),)


def _chunk(settings: Settings, chunk: ChunkSpec) -> ChunkSpec:
    """What the postprocessor leaves of an action."""
    most, kept = chunk.action_dim, settings.values.get("postprocess_action_dim")
    if kept is None or kept == most:
        return chunk
    if type(kept) is not int or not 1 <= kept < most:
        raise settings.refusal("postprocess_action_dim", f"null, or {most} at most, which an action has")
    own = chunk.normalizer
    own = None if own is None else Affine(own.scale[:kept], own.offset[:kept])
    return replace(chunk, action_dim=kept, normalizer=own)


def spoken(
    settings: Settings, config: Evo1Config, name: str, folder: Path, image: int, views: int, task: str | None
) -> tuple[tuple[tuple[int, ...], ...], Instruction, int, Tensor | None]:
    """The tokens of the prompt before each image, how a task is told, its tokens at most, and those of this one.

    Args:
        name: of the language model.
        folder: that has its tokenizer.
        image: the token that stands for an image.
        views: images of the prompt.
    """
    told = Instruction(TOKENS, MASK, False, tuple(_IMAGE.format(i + 1) for i in range(views)))
    vocabulary = config.language.vocabulary
    between, told = told_after(told, name, folder, vocabulary, image, views)
    images = told.skipped + views * (config.language.image_tokens - 1)
    length = settings.number("max_text_length", 1024, MOST) - images
    if length < 1:
        raise settings.refusal("max_text_length", f"more than the {images} tokens of {views} images", 1024)
    if task is None:
        return between, told, length, None
    tokens = task_tokens(told.line(task), name, folder, told.skipped + length, vocabulary, "")
    return between, told, length, torch.tensor([tokens[told.skipped :]])


def unread(config: Evo1Config) -> tuple[str, ...]:
    """Names of weights that nothing reads."""
    return (".embeddings.mask_token", *((".seq_pool_proj.weight", ".seq_pool_proj.bias") * (config.chunk_size == 1)))


def as_named(
    saved: Mapping[str, Tensor], settings: Settings, config: Evo1Config, model: Settings, rules: Sequence[Rule]
) -> Mapping[str, Tensor]:
    """The weights under the names of ``Evo1``; of those that each embodiment has, those of its own.

    Args:
        rules: by which those of the backbone are renamed.
    """
    kinds, own = settings.number("num_categories", 1, _MOST_KINDS), settings.values.get("default_embodiment_id", 0)
    if type(own) is not int or not 0 <= own < kinds:
        raise settings.refusal("default_embodiment_id", f"a number of the {kinds} embodiments (num_categories)", 0)
    if kinds > 1 and settings.values.get("embodiment_id_field") is not None:
        expected = f"null: the robot is embodiment {own}, default_embodiment_id, at every call"
        raise settings.refusal("embodiment_id_field", expected)
    found = dict[str, Tensor]()
    for before, value in saved.items():
        name = renamed(before, (*rules, *_HEAD, *((_SHARED,) * (kinds == 1))))
        if kinds > 1 and _BY_KIND.search(name) and len(value) == kinds:
            value = value[own].T.contiguous() if value.ndim == 3 else value[own].clone()
        found |= separated(name, value) if ".qkv." in name else {name: value}
    if not vla.part_of(model, "vision_config").flag("attention_bias", False):
        width = config.language.vision.hidden_size
        for layer in range(config.language.vision.num_hidden_layers):
            start = f"embedder.vision_tower.encoder.layers.{layer}.self_attn."
            found |= {f"{start}{one}_proj.bias": torch.zeros(width) for one in "qkv"}
    return found
