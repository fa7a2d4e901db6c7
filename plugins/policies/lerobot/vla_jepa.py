"""LeRobot's ``vla_jepa``: its directory to module and ``PolicySpec``; cameras, words and state to robot actions.

What it learns from videos is learned in training alone: no weight of V-JEPA is read but one, for its shape. Neither
lerobot nor transformers is needed. Source: ``VLAJEPAPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from string import Formatter
from typing import Any

import torch
from torch import Tensor, nn

from ttscompile.core.spec import LARGEST, Instruction, PolicySpec, Switch
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled, renamed
from ttscompile.frontends.settings import Settings

from ..instruction import encoder_folders, task_tokens, told_after
from ..networks.clip import TowerConfig
from ..networks.groot import Denoiser, Groot, GrootConfig, Prefix
from ..networks.image_geometry import ResizeCrop
from ..networks.internvl import Prompt
from ..networks.qwen3_vl import Qwen3VLConfig, rebuilt_weights
from . import qwen3_vl as qwen, vla
from .config import MOST, MOST_LAYERS, MOST_PIXELS, STATE, LeRobotConfig
from .policy import MASK, TOKENS, read_weights
from .processors import BINARIZE, CLIP, PREPARE, SNAP, Processors

_MOST_LETTERS, _MOST_TOKENS = 4000, 4096
_LENGTH = 64
"""Tokens of an instruction, of a policy that none is compiled into; lerobot has no limit."""
_TEMPLATE = (
    "Your task is {instruction}. Infer the temporal dynamics from frames {actions} and produce the corresponding policy"
    " actions {e_actions}."
)
_HEADS = ("action_num_heads", "action_attention_head_dim")
_PRESETS = {"DiT-B": (12, 64), "DiT-L": (32, 48), "DiT-test": (2, 8)}
"""What these two are where they are not said, by lerobot's name of the head's kind."""
_INNER, _VIDEO = "model.qwen.model.", "model.video_encoder."
_PATCHES = f"{_VIDEO}encoder.embeddings.patch_embeddings.proj.weight"
_UNREAD = ("model.video_predictor.", f"{_VIDEO}encoder.layer.", f"{_VIDEO}predictor.", ".language_model.norm.weight")
_RENAMED = (
    (r"^model\.action_model\.", "action_head."),
    (r"\.action_encoder\.layer(\d)\.", r".action_encoder.W\1."),
    (r"\.(action_decoder|state_encoder)\.layer(\d)\.", r".\1.fc\2."),
    *qwen.DIT_LAYERS,
)


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, {"chunk_size": 7, "n_action_steps": 7, **entries}, options, stateless=True)
    shared, processors = vla.read_vla_processors(shared)
    settings = shared.settings
    name = settings.text("qwen_model_name", "Qwen/Qwen3-VL-2B-Instruct", _MOST_LETTERS)
    backbone = qwen.find_backbone(name, encoder_folders(options.encoders, directory))
    resize = settings.size("resize_images_to", None, MOST_PIXELS)
    prepared = Settings(processors.own.get(PREPARE, {}), f"{directory}: {PREPARE}.")
    prepared.require(resize_to=resize and list(resize))
    sizes = [resize or (shape[1], shape[2]) for shape in shared.cameras.values()]
    seen = [qwen.read_resizing(backbone)(*each) for each in sizes]
    weights, language = read_weights(shared, options, *_UNREAD), qwen.read_language(backbone.model, MOST_LAYERS, seen)
    prompt, told, numbers = _prompt(shared, weights, name, backbone, language.vocabulary)
    config, task = read_config(shared, replace(language, vocabulary=numbers["vocabulary"])), None
    if options.task is not None:
        tokens = task_tokens(told.line(options.task), name, backbone.folder, None, numbers["vocabulary"], "")
        task = torch.tensor([tokens[told.skipped :]])
    own = _weights(weights, config)
    network = filled(lambda: Groot(config, prompt), own, "config.json, or the backbone's,", directory)
    encoder = vla.Gathered(shared, processors, Prefix(network, _Seen(sizes, seen)), config.state or None, task)
    last = settings.number("action_num_timestep_buckets", 1000, 2**20)
    table = partial(vla.in_buckets, settings, 4, last, CLIP in processors.own)
    spec = vla.vla_spec(shared, processors, resize, "average", numbers, options, table, told)
    spec = replace(spec, chunk=replace(spec.chunk, switches=_switches(shared, processors)))
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


class _Seen(nn.Module):
    """Images of each camera as the backbone sees them."""

    def __init__(self, before: list[tuple[int, int]], after: list[tuple[int, int]]) -> None:
        super().__init__()
        zooms = (ResizeCrop(*old, new, mode="bicubic") for old, new in zip(before, after, strict=True))
        self.zooms = nn.ModuleList(zooms)

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """See the class."""
        return [zoom(image) for zoom, image in zip(self.zooms, images, strict=True)]


def _switches(shared: LeRobotConfig, processors: Processors) -> tuple[Switch, ...]:
    """What LIBERO's rule of the gripper comes to: its number becomes 0 or 1, is unnormalised, and becomes 1 or -1.

    A policy may have one of these steps alone. LeRobot passes over a number that an action does not have.
    """
    names, limits = [name for name in (SNAP, BINARIZE) if name in processors.own], dict[str, float]()
    channels, ends = set[int](), torch.tensor([0.0, 1.0])
    for name in names:
        step = Settings(processors.own[name], f"{shared.directory}: {name}.")
        channels.add(step.number("gripper_dim", 6, MOST, least=0))
        limit = step.values.get("threshold", 0.5)
        if len(channels) > 1 or type(limit) not in (int, float) or not abs(limit) < LARGEST:
            raise step.error(f"found {step.values!s:.200}; expected a threshold, and the same gripper_dim in all steps")
        limits[name] = float(limit)
    channel = next(iter(channels), shared.action_dim)
    if channel >= shared.action_dim:
        return ()
    if processors.relative and processors.relative[channel] is not None:
        told = "is relative to the state, and then made one of two values, which is not compiled"
        raise shared.settings.error(f"number {channel} of an action {told}; expected it in relative_exclude_joints")
    below, above = (ends if processors.action is None else processors.action.unnormalized(ends, channel)).tolist()
    if BINARIZE in names:
        below, above = (1.0 - 2.0 * (end > limits[BINARIZE]) for end in (below, above))
    if SNAP in names:
        return (Switch(channel, limits[SNAP], below, above),)
    return (vla.switch(processors, channel, limits[BINARIZE], 1.0, -1.0),)


def _prompt(
    shared: LeRobotConfig, weights: Mapping[str, Tensor], name: str, backbone: qwen.Backbone, vocabulary: int
) -> tuple[Prompt, Instruction, dict[str, int]]:
    """What is around a task; how one is told; and numbers for ``vla_spec``.

    The last tokens are the ones that the head looks at the language model's answers to. Nothing that comes after them
    changes these. LeRobot adds the tokens of actions to those of the language model.
    """
    settings, (before, *others), cameras = shared.settings, _template(shared.settings), len(shared.cameras)
    last = settings.text("embodied_action_token", "<|embodied_action|>", _MOST_LETTERS)
    each, word = settings.number("num_action_tokens_per_timestep", 8, _MOST_TOKENS), _action_word(settings)
    words = [word.replace("{}", str(number)) for number in range(4 * shared.horizon)]
    actions, count = "".join(one * each for one in words[: _steps(settings, weights)]), _answers(settings)
    middle, *later = others if actions else ["".join(others)]
    *lines, first = f"{qwen.TURN}\n{qwen.IMAGE * cameras}{before}".split("\n")
    told = Instruction(TOKENS, MASK, False, tuple(lines), around=(first, middle))
    between, told = told_after(told, name, backbone.folder, vocabulary, backbone.image, cameras)
    tokenizer = Tokenizer(backbone.folder, CheckpointError)
    length, known = len(tokenizer(told.line(""))) - told.skipped + _LENGTH, tokenizer.with_words([*words, last])
    asked = tokenizer("".join(actions + text for text in later) + last * count)
    if asked.count(known[-1]) != count:
        raise settings.refusal("embodied_action_token", f"a word that the prompt holds {count} times", last)
    numbers = {"actions": shared.action_dim, "tokens": length, "vocabulary": max(vocabulary, tokenizer.size)}
    return Prompt(between, cameras, tuple(asked)), told, numbers


def _template(settings: Settings) -> list[str]:
    """What is before an instruction, after it, and, if actions are asked for, after these."""
    fields = ["instruction", "actions", "e_actions"]
    try:
        parts = list(Formatter().parse(settings.text("prompt_template", _TEMPLATE, _MOST_LETTERS)))
    except ValueError:
        parts = []
    texts, found = [text for text, *_ in parts], [field for _, field, *_ in parts if field is not None]
    formatted, lines = any(spec or kind for *_, spec, kind in parts), "".join(texts[1:]).split("\n")
    if formatted or found not in (fields, fields[::2]) or len(lines) > 1:
        expected = "text with {instruction}, {actions} (or not) and {e_actions}, in this order, in a line from there on"
        raise settings.refusal("prompt_template", expected, _TEMPLATE)
    return texts[: len(found)]


def _answers(settings: Settings) -> int:
    return settings.number("num_embodied_action_tokens_per_instruction", 32, _MOST_TOKENS)


def _action_word(settings: Settings) -> str:
    word = settings.text("special_action_token", "<|action_{}|>", _MOST_LETTERS)
    if word.count("{}") > 1 or set("{}") & set(word.replace("{}", "")):
        raise settings.refusal("special_action_token", "text in which {} stands for a number, at most once")
    return word


def _steps(settings: Settings, weights: Mapping[str, Tensor]) -> int:
    """Steps of a video that the prompt asks for: those of the video encoder, if it is saved with the policy."""
    own, video = settings.number("jepa_tubelet_size", 2, _MOST_TOKENS), weights.get(_PATCHES)
    learned = settings.flag("enable_world_model", True) and not settings.flag("freeze_qwen", False)
    frames = video.shape[2] if video is not None and video.ndim == 5 and learned else own
    return max(settings.number("num_video_frames", 8, _MOST_TOKENS) // frames - 1, 0)


def read_config(shared: LeRobotConfig, language: Qwen3VLConfig) -> GrootConfig:
    """Sizes and variant: those of a GR00T that looks at the last features alone, and has tokens of its own."""
    settings = shared.settings
    preset = zip(_HEADS, _PRESETS[settings.choice("action_model_type", *_PRESETS)], strict=True)
    heads, channels = (settings.number(name, None, MOST) if settings.values.get(name) else own for name, own in preset)
    layers, count = settings.number("action_num_layers", 16, MOST_LAYERS), _answers(settings)
    return GrootConfig(
        language=language,
        mixing=None,
        normed=False,
        layers=TowerConfig(heads * channels, 4 * heads * channels, layers, heads, "gelu_pytorch_tanh"),
        out=settings.number("action_hidden_size", 1024, MOST),
        state=shared.state_dim if STATE in shared.features else 0,
        actions=shared.action_dim,
        horizon=shared.horizon,
        places=shared.horizon,
        looks=tuple("itself" if layer % 2 else "words" for layer in range(layers)),
        apart=False,
        read=count,
        queries=count,
    )


def _weights(saved: Mapping[str, Tensor], config: GrootConfig) -> dict[str, Tensor]:
    """The weights under the names of ``Groot``; of places in a chunk, those that there are."""
    others, backbone = qwen.of_backbone(saved, _INNER, partial(rebuilt_weights, config=config.language))
    left = (_VIDEO,) if config.state else (_VIDEO, "model.action_model.state_encoder.")
    found = {renamed(name, _RENAMED): value for name, value in others.items() if not name.startswith(left)}
    if (places := "action_head.position_embedding.weight") in found:
        found[places] = found[places][: config.horizon].clone()
    return found | backbone
