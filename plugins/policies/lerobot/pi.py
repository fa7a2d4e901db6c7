"""LeRobot's ``pi0`` and ``pi05``: a directory to module and ``PolicySpec``; cameras, instruction, state to actions.

Sizes are those of the weights. Neither lerobot nor transformers is needed. Source: ``PI0Policy`` and ``PI05Policy`` of
huggingface/lerobot 0.6.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ttscompile.core.spec import Instruction, PolicySpec
from ttscompile.core.tokenizer import IN_WORDS, StateInWords
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled

from ..instruction import encoder_folders, find_encoder, task_tokens
from ..networks.language_layers import LanguageConfig
from ..networks.pi import Expert, Pi, PiConfig, Prefix
from ..networks.siglip import SiglipConfig
from . import vla
from .config import CONFIG, MOST, MOST_PIXELS, STATE, LeRobotConfig
from .policy import MASK, TOKENS, read_weights
from .processors import Processors

_VISION = "paligemma_with_expert.paligemma.model.vision_tower."
_TEXT = "paligemma_with_expert.paligemma.model.language_model."
_EXPERT = "paligemma_with_expert.gemma_expert.model."
_HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
UNREAD = (".gemma_expert.lm_head.weight", ".language_model.norm.weight", ".embed_tokens.position_ids")
TOKENIZER = "google/paligemma-3b-pt-224"
_VISION_HEADS = 16
"""Of PaliGemma's SigLIP; the weights do not say."""


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    (shared, processors), adaptive = vla.read_vla_processors(shared), entries["type"] == "pi05"
    weights = named_weights(read_weights(shared, options, *UNREAD))
    told: Instruction | None = Instruction(TOKENS, MASK, processors.new_line)
    if adaptive:
        stated = processors.state_in_prompt and shared.state_dim > 0
        told = told_with(_state_in_words(shared, processors)) if stated else None
    return built(shared, processors, read_config(shared, weights, adaptive), weights, told, options)


def built(
    shared: LeRobotConfig,
    processors: Processors,
    config: PiConfig,
    weights: Mapping[str, Tensor],
    told: Instruction | None,
    options: LoadOptions,
    fit: vla.Fit = "centre",
) -> tuple[nn.Module, PolicySpec]:
    """Network and specification of a policy, whoever saved it; see ``Family.load``.

    Args:
        weights: as ``named_weights`` gives them.
        told: how a task becomes tokens; None where no text alone does.
        fit: of the images, see ``ObservationSpec``.
    """
    directory, adaptive = shared.directory, config.adaptive
    if options.task is not None and (told is None or told.state is not None):
        raise CheckpointError(
            f"{directory}: a pi05 policy reads its state as part of the instruction, at every call; no task can be"
            " compiled in. Leave the task out, and give it at each call."
        )
    network = filled(lambda: Pi(config), weights, CONFIG, directory)
    length = shared.settings.number("tokenizer_max_length", 200 if adaptive else 48, MOST)
    sizes, task = {"actions": config.actions, "tokens": length, "vocabulary": config.vocabulary}, None
    if options.task is not None and told is not None:
        name = str(processors.tokenizer.get("tokenizer_name") or TOKENIZER)
        found = find_encoder(name, encoder_folders(options.encoders, directory), "paligemma")
        task = torch.tensor([task_tokens(told.line(options.task), name, found, length, config.vocabulary)])
    encoder = vla.Gathered(shared, processors, Prefix(network), config.state, task, config.trained_prefix > 0)
    side = config.vision.image_size
    spec = vla.vla_spec(shared, processors, (side, side), fit, sizes, options, told=told)
    if adaptive:  # the network reads no state but in the instruction; actions may be relative to it
        read = spec.chunk.relative or (told is not None and told.state is not None)
        unread = () if read else (processors.renamed.get(STATE, STATE),)
        others = {key: each for key, each in spec.observations.items() if key not in unread}
        instruction = None if told is None else spec.instruction
        spec = replace(spec, observations=others, instruction=instruction, trained_prefix=config.trained_prefix)
    return EncodedDenoiser(encoder, Expert(network)).eval(), spec


def _state_in_words(shared: LeRobotConfig, processors: Processors) -> StateInWords:
    key, own, count = processors.renamed.get(STATE, STATE), processors.normalizers.get(STATE), shared.state_dim
    first, width = ([0.0] * count, [1.0] * count) if own is None else (own.first.tolist(), own.width.tolist())
    return StateInWords(key, tuple(first), tuple(width), own is not None and own.mode != "MEAN_STD")


def told_with(state: StateInWords) -> Instruction:
    """How pi0.5 is told its task, as openpi's tokenizer and lerobot's step write it: with the state in words."""
    around, after = ("Task: ", f", State: {IN_WORDS};"), ("Action: ",)
    return Instruction(TOKENS, MASK, False, around=around, after=after, spaced=True, state=state)


def read_config(shared: LeRobotConfig, weights: Mapping[str, Tensor], adaptive: bool) -> PiConfig:
    """Sizes and variant."""
    try:
        return _read_config(shared, weights, adaptive)
    except CheckpointError as error:
        raise CheckpointError(f"{shared.directory}: {error}") from error


def _read_config(shared: LeRobotConfig, weights: Mapping[str, Tensor], adaptive: bool) -> PiConfig:
    settings, rounded = shared.settings, shared.settings.choice("dtype", "float32", "bfloat16") == "bfloat16"
    patch = _shape(weights, f"{_VISION}embeddings.patch_embedding.weight", 4)
    resolution = settings.size("image_resolution", [224, 224], MOST_PIXELS) or (224, 224)
    vla.require_square(settings, "image_resolution", resolution, patch[2])
    width = _shape(weights, f"{_VISION}encoder.layers.0.mlp.fc1.weight", 2)
    vision = SiglipConfig(
        hidden_size=patch[0],
        intermediate_size=width[0],
        num_hidden_layers=_layers(weights, f"{_VISION}encoder."),
        num_attention_heads=_VISION_HEADS,
        image_size=resolution[0],
        patch_size=patch[2],
    )
    text, expert = _language(weights, _TEXT), _language(weights, _EXPERT)
    if (text.layers, text.heads, text.channels) != (expert.layers, expert.heads, expert.channels):
        raise CheckpointError("the language model and the expert differ in layers, heads or channels.")
    delay = settings.number("rtc_training_max_delay", 0, shared.horizon - 1, least=0)
    return PiConfig(
        vision=vision,
        text=text,
        vocabulary=_shape(weights, f"{_TEXT}embed_tokens.weight", 2)[0],
        expert=expert,
        state=None if adaptive else vla.padded_size(settings, "max_state_dim", shared.state_dim),
        actions=vla.padded_size(settings, "max_action_dim", shared.action_dim),
        periods=(vla.positive_number(settings, "min_period", 4e-3), vla.positive_number(settings, "max_period", 4.0)),
        trained_prefix=delay,
        rounded=rounded,
        rounded_words=rounded,
    )


def _language(weights: Mapping[str, Tensor], start: str) -> LanguageConfig:
    queries, width = _shape(weights, f"{start}layers.0.self_attn.q_proj.weight", 2)
    channels = _shape(weights, f"{start}layers.0.self_attn.k_proj.weight", 2)[0]
    if channels % 2 or queries % channels:
        raise CheckpointError(f"{start}: {queries} numbers of queries do not fit heads of {channels}.")
    return LanguageConfig(
        width=width,
        hidden=_shape(weights, f"{start}layers.0.mlp.gate_proj.weight", 2)[0],
        layers=_layers(weights, start),
        heads=queries // channels,
        groups=1,
        channels=channels,
        gemma=True,
    )


def _layers(weights: Mapping[str, Tensor], start: str) -> int:
    found = re.compile(re.escape(start) + r"layers\.(\d{1,3})\.")
    return 1 + max((int(match[1]) for name in weights if (match := found.match(name))), default=-1)


def _shape(weights: Mapping[str, Tensor], name: str, axes: int) -> tuple[int, ...]:
    value = weights.get(name)
    if value is None or value.ndim != axes or not value.numel():
        raise CheckpointError(f"weight {name} is missing, or has not {axes} axes; expected weights of a pi0 or pi05.")
    return tuple(value.shape)


def named_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Saved weights under the names of ``Pi``, whichever transformers saved them, lerobot or openpi."""
    found = {}
    for name, value in weights.items():
        short = name.removeprefix("model.").replace(".vision_tower.vision_model.", ".vision_tower.")
        if not short.startswith(f"{_VISION}head."):
            found[short] = value
    head = found.pop(_HEAD, None)
    if head is not None:  # the same numbers as the embedding, of which a file may have either
        found.setdefault(f"{_TEXT}embed_tokens.weight", head)
    return found
