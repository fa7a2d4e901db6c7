"""LeRobot's ``smolvla``: its network, rebuilt, and its directory to that and ``PolicySpec``.

Cameras, instruction and state become keys and values of a prefix, and an expert denoises beside it. Attribute names are
those under which lerobot saves the weights; neither lerobot nor transformers is needed.

Sources: Shukor et al., SmolVLA (arXiv 2506.01844); ``lerobot.policies.smolvla`` of huggingface/lerobot 0.6.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..core.spec import PolicySpec
from . import language_layers as layers, lerobot_vla as vla
from .clip import find_encoder
from .encoded import EncodedDenoiser
from .families import LoadOptions
from .instruction import encoder_folders, language_model_folder, task_tokens
from .lerobot_config import CONFIG, MOST, MOST_PIXELS, LeRobotConfig
from .lerobot_policy import read_weights
from .saved_weights import filled
from .settings import Settings, read_json
from .siglip import Siglip, SiglipConfig, squares

_MULTIPLE = 256
"""Of the expert's feed-forward layers."""


@dataclass(frozen=True)
class SmolVLAConfig:
    """Sizes and variant.

    Attributes:
        text: of the language model, whose first ``text.layers`` are used.
        scale: patches along each axis that become one token.
        image: height and width of the images that the encoder sees.
        crosses: whether layer ``i`` of the expert sees the prefix alone; otherwise prefix and actions.
        state: numbers of the state, padded.
        actions: numbers of an action, padded.
        periods: shortest and longest of the timestep's waves.
    """

    vision: SiglipConfig
    text: layers.LanguageConfig
    vocabulary: int
    scale: int
    image: tuple[int, int]
    expert: layers.LanguageConfig
    crosses: tuple[bool, ...]
    state: int
    actions: int
    periods: tuple[float, float]


def expert_of(text: layers.LanguageConfig, multiplier: float) -> layers.LanguageConfig:
    """The expert beside a language model: narrower, with the same heads."""
    width = int(text.width * multiplier)
    hidden = _MULTIPLE * math.ceil(int(4 * int(2 * width / 3)) / _MULTIPLE)
    return layers.LanguageConfig(width, hidden, text.layers, text.heads, text.groups, text.channels, text.epsilon)


class _Connector(nn.Module):
    """Squares of ``scale`` by ``scale`` patches to one token each."""

    modality_projection: Any

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        self.scale = config.scale
        self.rows = config.image[0] // config.vision.patch_size
        self.modality_projection = nn.Module()
        width = config.vision.hidden_size * config.scale**2
        self.modality_projection.proj = nn.Linear(width, config.text.width, bias=False)

    def forward(self, patches: Tensor) -> Tensor:
        """``[N, patches, width]`` -> ``[N, tokens, width of the language model]``."""
        return self.modality_projection.proj(squares(patches, self.rows, self.scale))  # type: ignore[no-any-return]


class _ExpertLayer(nn.Module):
    def __init__(self, config: SmolVLAConfig, crosses: bool) -> None:
        super().__init__()
        expert = config.expert
        self.crosses = crosses
        self.input_layernorm, self.post_attention_layernorm = layers.Norm(expert), layers.Norm(expert)
        self.self_attn = layers.Attention(expert, config.text.groups * config.text.channels if crosses else None)
        self.mlp = layers.FeedForward(expert)

    def forward(
        self, x: Tensor, prefix: layers.Seen, turns: layers.Rotation, own_turns: layers.Rotation, mask: Tensor
    ) -> Tensor:
        """``prefix`` in groups; ``mask`` of the prefix, or of prefix and actions."""
        attention = self.self_attn
        normed = self.input_layernorm(x)
        queries = attention.split(attention.q_proj(normed))
        if self.crosses:
            keys, values = (each.transpose(1, 2).flatten(2) for each in prefix)
            keys, values = attention.split(attention.k_proj(keys)), attention.split(attention.v_proj(values))
            seen = layers.Seen(attention.for_all_heads(keys), attention.for_all_heads(values))
            x = x + attention.attend(layers.rotate(queries, own_turns), seen, mask)
        else:
            keys = layers.rotate(attention.split(attention.k_proj(normed)), turns)
            values = attention.split(attention.v_proj(normed))
            pairs = ((prefix.keys, keys), (prefix.values, values))
            seen = layers.Seen(*(torch.cat([attention.for_all_heads(each) for each in pair], 2) for pair in pairs))
            x = x + attention.attend(layers.rotate(queries, turns), seen, mask)
        return x + self.mlp(self.post_attention_layernorm(x))  # type: ignore[no-any-return]


class SmolVLA(nn.Module):
    """The whole network, under the names of lerobot's ``VLAFlowMatching``."""

    vlm_with_expert: Any

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        width = config.expert.width
        both: Any = nn.Module()
        self.config = config
        both.vlm = nn.Module()
        both.vlm.model = nn.Module()
        both.vlm.model.vision_model = Siglip(config.vision, config.image)
        both.vlm.model.connector = _Connector(config)
        both.vlm.model.text_model = layers.Words(config.vocabulary, config.text)
        both.lm_expert = nn.Module()
        both.lm_expert.layers = nn.ModuleList(_ExpertLayer(config, crosses) for crosses in config.crosses)
        both.lm_expert.norm = layers.Norm(config.expert)
        self.vlm_with_expert = both
        self.state_proj = nn.Linear(config.state, config.text.width)
        self.action_in_proj, self.action_out_proj = nn.Linear(config.actions, width), nn.Linear(width, config.actions)
        self.action_time_mlp_in, self.action_time_mlp_out = nn.Linear(2 * width, width), nn.Linear(width, width)


class Prefix(nn.Module):
    """What the network reads once a call."""

    def __init__(self, network: SmolVLA) -> None:
        super().__init__()
        model: Any = network.vlm_with_expert.vlm.model
        self.channels, self.width = network.config.text.channels, network.config.text.width
        self.vision_model, self.connector, self.text_model = model.vision_model, model.connector, model.text_model
        self.state_proj = network.state_proj

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """Which tokens count, ``[B, P]``, then keys and values of each layer.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``.
            state: padded ``[B, Ds]``.
        """
        scale = math.sqrt(self.width)
        seen = self.connector(self.vision_model(torch.stack(images, 1).flatten(0, 1))) * scale
        seen = seen.unflatten(0, (-1, len(images))).flatten(1, 2)
        words = self.text_model.embed_tokens(tokens) * scale
        x = torch.cat([seen, words, self.state_proj(state)[:, None]], 1)
        valid = functional.pad(mask, (seen.shape[1], 1), value=True)
        turns = layers.rotation(torch.cumsum(valid, 1) - 1, self.channels)
        # Images and words do not see the state.
        return valid, *layers.read_prefix(self.text_model.layers, x, turns, layers.prefix_mask(valid, late=1))


class Expert(nn.Module):
    """The denoiser."""

    def __init__(self, network: SmolVLA) -> None:
        super().__init__()
        expert: Any = network.vlm_with_expert.lm_expert
        self.config = network.config
        self.layers, self.norm = expert.layers, expert.norm
        self.action_in_proj, self.action_out_proj = network.action_in_proj, network.action_out_proj
        self.action_time_mlp_in = network.action_time_mlp_in
        self.action_time_mlp_out = network.action_time_mlp_out

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 1 to 0 and what ``Prefix`` gives -> the velocity ``[B, T, D]``."""
        valid, *seen = encoded
        config, count = self.config, sample.shape[1]
        x = self.action_in_proj(sample)
        time = layers.waves(timestep, config.expert.width, *config.periods)
        x = torch.cat([x, time[:, None].expand_as(x)], 2)
        x = self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(x)))
        own = torch.arange(count, device=x.device)[None]
        own_turns = layers.rotation(own, config.expert.channels)
        turns = layers.rotation(valid.sum(-1, keepdim=True) + own, config.expert.channels)
        crossing = layers.added(valid[:, None, None, :])
        # Actions see the prefix, and each other backwards in time.
        later = layers.added(torch.ones(count, count, dtype=torch.bool, device=x.device).tril())[None, None]
        whole = torch.cat([crossing.expand(-1, -1, count, -1), later.expand(len(sample), -1, -1, -1)], 3)
        for i, layer in enumerate(self.layers):
            prefix = layers.Seen(seen[2 * i], seen[2 * i + 1])
            x = layer(x, prefix, turns, own_turns, crossing if layer.crosses else whole)
        return self.action_out_proj(self.norm(x))  # type: ignore[no-any-return]


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

_MOST_LAYERS, _MOST_VOCABULARY, _MOST_LETTERS = 512, 2**20, 400
_UNREAD = (".vlm.lm_head.weight", ".text_model.norm.weight")
"""Weights of what the policy does not compute: the language model's answer."""


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    settings, processors = shared.settings, vla.read_vla_processors(shared)
    folders = encoder_folders(options.encoders, directory)
    name = settings.text("vlm_model_name", _MODEL, _MOST_LETTERS)
    config = read_config(shared, _language_model(name, folders))
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
    settings.require(add_image_special_tokens=False, use_delta_joint_actions_aloha=False)
    vision_entries, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    names = {field for field in SiglipConfig.__dataclass_fields__ if field in vision_entries.values}
    vision = SiglipConfig(**{name: vision_entries.values[name] for name in names})
    layers = _layers(settings, text.number("num_hidden_layers", None, _MOST_LAYERS))
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
        vocabulary=text.number("vocab_size", None, _MOST_VOCABULARY),
        scale=scale,
        image=_image(shared, vision.patch_size * scale),
        expert=expert,
        crosses=_crosses(settings, layers),
        state=vla.padded_size(settings, "max_state_dim", shared.state_dim),
        actions=vla.padded_size(settings, "max_action_dim", shared.action_dim),
        periods=(vla.positive_number(settings, "min_period", 4e-3), vla.positive_number(settings, "max_period", 4.0)),
    )


def _image(shared: LeRobotConfig, multiple: int) -> tuple[int, int]:
    """What the encoder sees; lerobot saves width before height."""
    resize = shared.settings.size("resize_imgs_with_padding", [512, 512], MOST_PIXELS)
    height, width = vla.seen_size(shared, None if resize is None else (resize[1], resize[0]))
    vla.require_square(shared.settings, "resize_imgs_with_padding", (height, width), multiple)
    return height, width


def _layers(settings: Settings, there: int) -> int:
    wanted, expert = settings.values.get("num_vlm_layers", 16), settings.values.get("num_expert_layers", -1)
    if type(wanted) is not int or type(expert) is not int:
        raise settings.refusal("num_vlm_layers", "a whole number, as num_expert_layers is")
    used = min(wanted, there) if wanted > 0 else there
    if expert > 0 and expert != used:
        raise settings.refusal("num_expert_layers", f"none, or {used} as the language model has: fewer are not rebuilt")
    return used


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
