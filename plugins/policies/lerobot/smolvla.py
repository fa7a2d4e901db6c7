"""LeRobot's ``smolvla``: its directory to module and ``PolicySpec``; cameras, instruction and state to robot actions.

Neither lerobot nor transformers is needed. Source: ``SmolVLAPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ttscompile.core.spec import PolicySpec
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled
from ttscompile.frontends.settings import Settings, read_json

from ..instruction import encoder_folders, find_encoder, language_model_folder, task_tokens
from ..networks.siglip import SiglipConfig
from ..networks.smolvla import Expert, Prefix, SmolVLA, SmolVLAConfig, expert_of
from . import vla
from .config import CONFIG, MOST, MOST_CAMERAS, MOST_LAYERS, MOST_LETTERS, MOST_PIXELS, MOST_VOCABULARY, LeRobotConfig
from .policy import read_weights

_MODEL = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
RELEASED: Mapping[str, Mapping[str, Any]] = {
    _MODEL: {
        "scale_factor": 4,
        "vision_config": {"hidden_size": 768, "num_attention_heads": 12, "image_size": 512, "patch_size": 16},
        "text_config": {
            "hidden_size": 960,
            "intermediate_size": 2560,
            "num_hidden_layers": 32,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
            "head_dim": 64,
            "rms_norm_eps": 1e-5,
            "vocab_size": 49280,
        },
    }
}
"""Configurations of the released models: with these names nothing but the policy's own weights is needed."""

_LLAMA = {"hidden_size": 4096, "intermediate_size": 11008, "vocab_size": 32000}
_LLAMA |= dict.fromkeys(("num_attention_heads", "num_hidden_layers"), 32)
"""What transformers takes for an entry that a language model's file leaves out."""

_UNREAD = (".vlm.lm_head.weight", ".text_model.norm.weight")
"""Weights of what the policy does not compute: the language model's answer."""

_AROUND = ("<fake_token_around_image>", "<global-img>")


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    shared, processors = vla.read_vla_processors(shared)
    settings = shared.settings
    folders = encoder_folders(options.encoders, directory)
    name = settings.text("vlm_model_name", _MODEL, MOST_LETTERS)
    config = read_config(shared, _language_model(name, folders))
    if settings.flag("add_image_special_tokens", False):
        config = _with_words_around(config, shared, language_model_folder(name, folders, "smolvlm"))
    length = settings.number("tokenizer_max_length", 48, MOST)
    sizes, task = {"actions": config.actions, "tokens": length, "vocabulary": config.vocabulary}, None
    if options.task is not None:
        tokenizer = str(processors.tokenizer.get("tokenizer_name") or name)
        text = options.task if options.task.endswith("\n") or not processors.new_line else f"{options.task}\n"
        found = find_encoder(tokenizer, folders, "smolvlm")
        task = torch.tensor([task_tokens(text, tokenizer, found, length, config.vocabulary)])
    weights = {name.removeprefix("model."): value for name, value in read_weights(shared, options, *_UNREAD).items()}
    network = filled(lambda: SmolVLA(config), weights, "config.json, or the language model's,", directory)
    encoder = vla.Gathered(shared, processors, Prefix(network), config.state, task)
    resize = None if settings.values.get("resize_imgs_with_padding", 0) is None else config.image
    spec = vla.vla_spec(shared, processors, resize, "start", sizes, options)
    return EncodedDenoiser(encoder, Expert(network)).eval(), spec


def read_config(shared: LeRobotConfig, model: Settings) -> SmolVLAConfig:
    """Sizes and variant, of the policy's entries and those of its language model."""
    settings = shared.settings
    settings.require(use_delta_joint_actions_aloha=False)
    vision_entries, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    text = Settings(_LLAMA | dict(text.values), text.where)
    text.require(hidden_act="silu", attention_bias=False, mlp_bias=False)
    names = {field for field in SiglipConfig.__dataclass_fields__ if field in vision_entries.values}
    vision = SiglipConfig(**{name: vision_entries.values[name] for name in names})
    layers = _layers(settings, text.number("num_hidden_layers", None, MOST_LAYERS))
    crosses = _crosses(settings, layers)
    every = _every(settings, crosses)
    heads, width = text.number("num_attention_heads", None, MOST), text.number("hidden_size", None, MOST)
    own = Settings({"num_key_value_heads": heads} | dict(text.values), text.where)
    language = vla.read_language(own, layers, width // heads)
    expert = expert_of(language, vla.positive_number(settings, "expert_width_multiplier", 0.75))
    scale = model.number("scale_factor", 2)
    if not 2 <= expert.width <= MOST or expert.width % 2:
        raise settings.refusal("expert_width_multiplier", f"a share that leaves an even width of {width}", 0.75)
    return SmolVLAConfig(
        vision=vision,
        text=language,
        vocabulary=text.number("vocab_size", None, MOST_VOCABULARY),
        scale=scale,
        image=_image(shared, vision.patch_size * scale),
        expert=expert,
        crosses=crosses[::every],
        state=vla.padded_size(settings, "max_state_dim", shared.state_dim),
        actions=vla.padded_size(settings, "max_action_dim", shared.action_dim),
        periods=(vla.positive_number(settings, "min_period", 4e-3), vla.positive_number(settings, "max_period", 4.0)),
        every=every,
    )


def _with_words_around(config: SmolVLAConfig, shared: LeRobotConfig, folder: Path) -> SmolVLAConfig:
    """With the tokens around each image, those of cameras counted that lerobot shows as black ones."""
    tokenizer, settings = Tokenizer(folder, CheckpointError), shared.settings
    known = min(tokenizer.size, config.vocabulary)
    image, whole = tokenizer.with_words(_AROUND)
    if max(image, whole) >= known:
        found = f"its tokenizer has no {' or no '.join(_AROUND)} among the {known} tokens that the model knows"
        raise CheckpointError(f"{folder}: {found}; add_image_special_tokens needs both. It is of another model.")
    features = settings.values["input_features"].values()
    missing = sum(feature.get("type") == "VISUAL" for feature in features) - len(shared.cameras)
    absent = min(missing, settings.number("empty_cameras", 0, MOST_CAMERAS, least=0))
    return replace(config, around=((image, whole), (image,)), absent=absent)


def _image(shared: LeRobotConfig, multiple: int) -> tuple[int, int]:
    """What the encoder sees; lerobot saves width before height."""
    resize = shared.settings.size("resize_imgs_with_padding", [512, 512], MOST_PIXELS)
    height, width = vla.seen_size(shared, None if resize is None else (resize[1], resize[0]))
    vla.require_square(shared.settings, "resize_imgs_with_padding", (height, width), multiple)
    return height, width


def _layers(settings: Settings, there: int) -> int:
    wanted = settings.values.get("num_vlm_layers", 16)
    if type(wanted) is not int:
        raise settings.refusal("num_vlm_layers", "a whole number", 16)
    return min(wanted, there) if wanted > 0 else there


def _every(settings: Settings, crosses: tuple[bool, ...]) -> int:
    """Layers of the language model to each of the expert. With fewer, lerobot fails where one does not cross."""
    own, used = settings.values.get("num_expert_layers", -1), len(crosses)
    if type(own) is not int or (own > 0 and (used % own or (own < used and not all(crosses[1:])))):
        expected = f"none, {used} as the language model has, or a part of it if all cross (self_attn_every_n_layers -1)"
        raise settings.refusal("num_expert_layers", expected, -1)
    return used // own if own > 0 else 1


def _crosses(settings: Settings, layers: int) -> tuple[bool, ...]:
    crossing = settings.choice("attention_mode", "cross_attn", "self_attn") == "cross_attn"
    every = settings.values.get("self_attn_every_n_layers", 2)
    if type(every) is not int:
        raise settings.refusal("self_attn_every_n_layers", "a whole number")
    return tuple(crossing and not (every > 0 and i % every == 0) for i in range(layers))


def _language_model(name: str, folders: list[Path]) -> Settings:
    """The entries of the language model's ``config.json``."""
    if name in RELEASED and find_encoder(name, folders, "smolvlm") is None:
        return Settings(RELEASED[name], f"{name}: ")
    path = language_model_folder(name, folders, "smolvlm") / CONFIG
    return Settings(read_json(path), f"{path}: ")
