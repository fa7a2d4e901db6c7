"""LeRobot's ``xvla``: its directory to module and ``PolicySpec``; cameras, instruction and state to robot actions.

Neither lerobot nor transformers is needed. Source: ``XVLAPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ttscompile.core.coercion import integer
from ttscompile.core.spec import PolicySpec, SamplerTable
from ttscompile.errors import SpecError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled, renamed, separated
from ttscompile.frontends.settings import Settings
from ttscompile.samplers.flow import deterministic_table

from ..instruction import encoder_folders, find_encoder, task_tokens
from ..networks.clip import TowerConfig
from ..networks.florence import FlorenceConfig
from ..networks.internvl import MEAN
from ..networks.xvla import XVLA, Denoiser, Prefix, XVLAConfig
from .config import ACTION, CONFIG, MOST, MOST_PIXELS, STATE, LeRobotConfig
from .florence import read_florence
from .policy import integration_steps, read_weights
from .processors import DOMAIN, IMAGENET, OWN_STEPS, Processors
from .vla import Gathered, part_of, positive_number, read_vla_config, read_vla_processors, seen_size, vla_spec

_MOST_LETTERS, _MOST_VIEWS, _MOST_DOMAINS = 400, 64, 4096
_TIED = "vlm.language_model.embed_tokens.weight"
_PROJECTION = "vlm.image_projection"
_RENAMED = (
    # As Microsoft's code names them, in checkpoints of earlier versions of lerobot:
    (r"^vlm\.vision_tower\.convs\.(\d+)\.proj\.", r"vlm.vision_tower.convs.\1.conv."),
    (r"\.(conv[12])\.fn\.dw\.", r".\1."),
    (r"\.(window|channel)_attn\.norm\.", ".norm1."),
    (r"\.(window|channel)_attn\.fn\.", r".\1_attn."),
    (r"\.ffn\.norm\.", ".norm2."),
    (r"\.ffn\.fn\.net\.", ".ffn."),
    (r"^vlm\.image_proj_norm\.", "vlm.multi_modal_projector.image_proj_norm."),
    (r"^vlm\.image_pos_embed\.", "vlm.multi_modal_projector.image_position_embed."),
    (r"^vlm\.visual_temporal_embed\.", "vlm.multi_modal_projector.visual_temporal_embed."),
    (r"^vlm\.language_model\.model\.", "vlm.language_model."),
    # As transformers and lerobot name them:
    (r"\.(window_|channel_)?attn\.(qkv|proj)\.", r".self_attn.\2."),
    (r"\.self_attn\.proj\.", ".self_attn.out_proj."),
    (r"^vlm\.language_model\.encoder\.", "vlm.language_model."),
    (r"^(vlm\.language_model\.layers\.\d+)\.fc", r"\1.mlp.fc"),
    (r"\.image_position_embed\.", "."),
    (r"\.visual_temporal_embed\.pos_idx_to_embed$", ".moments"),
    (r"^transformer\.blocks\.(\d+)\.norm([12])\.", r"transformer.blocks.layers.\1.layer_norm\2."),
    (r"^transformer\.blocks\.(\d+)\.", r"transformer.blocks.layers.\1."),
)
_OF_DOMAIN = (
    (r"\.(action_encoder|action_decoder|vlm_proj|aux_visual_proj)\.fc\.weight$", r".\1.weight"),
    (r"\.(action_encoder|action_decoder|vlm_proj|aux_visual_proj)\.bias\.weight$", r".\1.bias"),
    (r"\.soft_prompt_hub\.weight$", ".soft_prompts"),
)
"""Weights that each robot has of its own, as rows."""


class _Mode(NamedTuple):
    """What lerobot calls an action space: numbers of an action, how many are the robot's, and which are grippers."""

    actions: int
    kept: int
    grippers: tuple[int, ...] = ()


_MODES: Mapping[str, _Mode] = {
    "ee6d": _Mode(20, 20, (9, 19)),
    "joint": _Mode(14, 14, (6, 13)),
    "agibot_ee6d": _Mode(20, 20),
    "franka_joint7": _Mode(20, 7),
    "so101_bimanual": _Mode(20, 12, (5, 11)),
}


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    stateless = entries.get("use_proprio") is False
    shared = read_vla_config(directory, {"chunk_size": 32, "n_action_steps": 32, **entries}, options, stateless)
    settings = shared.settings
    mode, proprio = _mode(shared), settings.flag("use_proprio", True)
    features = {key: each for key, each in shared.features.items() if proprio or key != STATE}
    shared = replace(shared, features=features | {ACTION: ("ACTION", (mode.kept,))})
    shared, processors = read_vla_processors(shared)
    resize = settings.size("resize_imgs_with_padding", None, MOST_PIXELS)
    size, colours = seen_size(shared, resize), _colours(shared, processors)
    florence = read_florence(part_of(settings, "florence_config"), size, colours)
    task, length, padding = _words(shared, processors, florence, options)
    config = read_config(shared, florence, mode, length, padding)
    domain = _domain(settings, processors)
    with torch.device("meta"):
        empty = XVLA(config)
    network = filled(lambda: empty, _weights(shared, options, empty, domain), CONFIG, directory)
    encoder = Gathered(shared, processors, Prefix(network), config.state or None, task)
    sizes = {"actions": mode.actions, "tokens": length, "vocabulary": florence.text.vocab_size}
    spec = vla_spec(shared, processors, resize, "start", sizes, options, lambda each: _sampler(settings, each))
    observations = dict(spec.observations)
    for key, own in zip(shared.cameras, colours, strict=True):
        if resize and own:  # lerobot resizes what is normalised
            name = processors.renamed.get(key, key)
            observations[name] = replace(observations[name], fill=MEAN)
    spec = replace(spec, observations=observations, source={**spec.source, "domain": str(domain)})
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def read_config(shared: LeRobotConfig, florence: FlorenceConfig, mode: _Mode, length: int, padding: int) -> XVLAConfig:
    """Sizes and variant.

    Args:
        length: tokens of an instruction.
        padding: the token after its end.
    """
    settings = shared.settings
    width, ratio = settings.number("hidden_size", 1024, MOST), positive_number(settings, "mlp_ratio", 4.0)
    state = settings.number("max_state_dim", 32, MOST) if STATE in shared.features else 0
    if mode.grippers and state <= max(mode.grippers):
        expected = f"a state of {max(mode.grippers) + 1} numbers at least (max_state_dim), with this action_mode"
        raise settings.refusal("max_state_dim" if state else "use_proprio", expected, 32)
    heads, layers = settings.number("num_heads", 16, MOST), settings.number("depth", 24, MOST)
    config = XVLAConfig(
        florence=florence,
        layers=TowerConfig(width, int(width * ratio), layers, heads, "gelu_pytorch_tanh"),
        chunk_size=shared.horizon,
        actions=mode.actions,
        grippers=mode.grippers,
        state=state,
        time=settings.number("dim_time", 32, MOST),
        prompts=settings.number("len_soft_prompts", 32, MOST, least=0),
        positions=settings.number("max_len_seq", 512, MOST),
        views=_views(shared),
        padding=padding,
    )
    read = florence.image_tokens + length
    if read > florence.text.max_position_embeddings:
        raise settings.error(f"florence_config.text_config.max_position_embeddings: expected {read} at least")
    tokens = shared.horizon + read + (config.views - 1) * florence.image_tokens
    if tokens > config.positions:
        raise settings.refusal("max_len_seq", f"{tokens} at least, for {config.views} views of this size", 512)
    return config


def _mode(shared: LeRobotConfig) -> _Mode:
    settings = shared.settings
    name = settings.text("action_mode", "ee6d", _MOST_LETTERS).lower()
    if name == "auto":
        most = settings.number("max_action_dim", 20, MOST)
        return _Mode(most, min(shared.action_dim, most))
    if name not in _MODES:
        raise settings.refusal("action_mode", f"one of {', '.join(_MODES)}, auto")
    if name == "so101_bimanual" and settings.values.get("max_state_dim", 32) != 20:
        raise settings.refusal("max_state_dim", "20, with the action_mode so101_bimanual", 32)
    return _MODES[name]


def _views(shared: LeRobotConfig) -> int:
    """Images of the network, those of no camera counted, as lerobot counts them when it loads a policy."""
    settings, name = shared.settings, "num_image_views"
    own = 0 if settings.values.get(name) is None else settings.number(name, None, _MOST_VIEWS)
    cameras: int = sum(feature.get("type") == "VISUAL" for feature in settings.values["input_features"].values())
    return max(own, cameras + settings.number("empty_cameras", 0, _MOST_VIEWS, least=0))


def _domain(settings: Settings, processors: Processors) -> int:
    """Which robot it is, of those that the network knows: what the preprocessor says, or the first."""
    if settings.values.get("domain_feature_key") not in (None, "domain_id"):
        expected = f"null: the robot is the domain_id of {DOMAIN}, at every call"
        raise settings.refusal("domain_feature_key", expected)
    count = settings.number("num_domains", 30, _MOST_DOMAINS)
    step = Settings(processors.own.get(DOMAIN, {}), f"{settings.where}num_domains is {count}, and {DOMAIN}.")
    return step.number("domain_id", 0, count - 1, least=0)


def _colours(shared: LeRobotConfig, processors: Processors) -> tuple[bool, ...]:
    """Of each camera whether its images are normalised by the colours of ImageNet."""
    if IMAGENET not in processors.own:
        return (False,) * len(shared.cameras)
    if list(processors.own) != [name for name in OWN_STEPS["xvla"] if name in processors.own]:
        raise shared.settings.error(f"{IMAGENET} is before xvla_image_to_float; expected it after")
    keys = processors.own[IMAGENET].get("image_keys")
    # lerobot passes over a single camera's name, observation.image, where no names are given.
    every = keys if isinstance(keys, list) else [key for key in shared.cameras if key.startswith("observation.images")]
    return tuple(key in every for key in shared.cameras)


def _words(
    shared: LeRobotConfig, processors: Processors, florence: FlorenceConfig, options: LoadOptions
) -> tuple[Tensor | None, int, int]:
    """Tokens of the instruction that is compiled in, int64 ``[1, L]``; L; and the token after the end of one."""
    step = Settings(processors.tokenizer, f"{shared.directory}: tokenizer_processor.")
    if not processors.tokenizer or not step.flag("truncation", True):
        raise step.error("expected such a step, which cuts an instruction (truncation: true)")
    name = step.text("tokenizer_name", "facebook/bart-large", _MOST_LETTERS)
    length, padding = step.number("max_length", 512, MOST), step.choice("padding", "max_length", "longest")
    side = step.choice("padding_side", "right", "left")
    text = part_of(part_of(shared.settings, "florence_config"), "text_config")
    vocabulary = florence.text.vocab_size
    pad = text.number("pad_token_id", 1, vocabulary - 1, least=0)
    if options.task is None:
        if (padding, side) != ("max_length", "right"):
            remedy = "Compile one in: task= in Python, --task on the command line"
            raise step.error(f"padding is {padding}, at the {side}: instructions differ in length. {remedy}")
        return None, length, pad
    folders = encoder_folders(options.encoders, shared.directory)
    folder = find_encoder(name, folders, "bart") or find_encoder(name, folders, "florence")
    tokens = task_tokens(options.task, name, folder, length, vocabulary)
    more = [pad] * (length - len(tokens) if padding == "max_length" else 0)
    tokens = tokens + more if side == "right" else more + tokens
    return torch.tensor([tokens]), len(tokens), pad


def _sampler(settings: Settings, options: LoadOptions) -> SamplerTable:
    if options.sampler is not None:
        raise SpecError(f"sampler {options.sampler!r}: the loop of xvla is its own. Leave it out; steps may be others.")
    return remixed_table(integration_steps(settings, options, "num_denoising_steps", 10))


def remixed_table(steps: int) -> SamplerTable:
    """The denoising loop of X-VLA, whose network predicts the actions themselves, at times from 1 to 0 in equal steps.

    Each sample is the last prediction mixed with the noise that the call began with, which is the memory::

        next = (1 - later) out + later noise
    """
    count = integer(steps, "steps", SpecError, 1)
    times, first = np.arange(count, -1, -1) / count, np.arange(count) == 0
    later, to_memory = times[1:], np.zeros((count, 1, 4))
    to_memory[first, 0, 1] = to_memory[~first, 0, 3] = 1
    return deterministic_table(
        "remix",
        times[:-1],
        None,
        out_to_x0=np.ones(count),
        sample_to_next=np.where(first, later, 0),  # at first the sample is the noise
        out_to_next=1 - later,
        memory_to_next=np.where(first, 0, later)[:, None],
        to_memory=to_memory,
    )


def _weights(shared: LeRobotConfig, options: LoadOptions, network: XVLA, domain: int) -> dict[str, Tensor]:
    """The weights under the names of ``XVLA``; of those that each robot has of its own, this one's."""
    count, found = shared.settings.number("num_domains", 30, _MOST_DOMAINS), dict[str, Tensor]()
    expected = network.state_dict()
    for saved, value in read_weights(shared, options, ".final_logits_bias").items():
        name = renamed(saved.removeprefix("model."), _RENAMED)
        of_domain = next((re.sub(*each, name) for each in _OF_DOMAIN if re.search(each[0], name)), None)
        if name == _PROJECTION:
            found["vlm.multi_modal_projector.image_projection.weight"] = value.T.contiguous()
        elif ".qkv." in name:
            found |= separated(name, value)
        elif of_domain in expected and value.shape == (count, expected[of_domain].numel()):
            turned = value[domain].view(expected[of_domain].shape[::-1]).movedim(0, -1)
            found[of_domain] = turned.clone(memory_format=torch.contiguous_format)
        else:
            found[name] = value
    if _TIED in found:
        found.setdefault("vlm.language_model.shared.weight", found.pop(_TIED))
    for name in expected.keys() - found.keys():
        if re.search(r"^vlm\.vision_tower\..*\.[qkv]_proj\.bias$", name):  # qkv_bias: false
            found[name] = torch.zeros(expected[name].shape)
    mixed, config = found.get("transformer.action_encoder.weight"), network.config
    if mixed is not None and mixed.shape == expected["transformer.action_encoder.weight"].shape:
        for gripper in config.grippers:  # lerobot clears what the network would read of them
            mixed[:, gripper] = mixed[:, config.actions + gripper] = 0
    return found
