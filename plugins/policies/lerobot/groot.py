"""LeRobot's ``groot``, GR00T N1.7: its directory to module and ``PolicySpec``; cameras, words, state to robot actions.

Neither lerobot nor transformers is needed. Sizes are those of the base model's and of its backbone's folders, which
lerobot needs, too. Source: ``GrootPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ttscompile.core.spec import Instruction, PolicySpec, Switch
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled, renamed
from ttscompile.frontends.settings import Settings, read_json

from ..instruction import encoder_folders, language_model_folder, task_tokens, told_after
from ..networks.clip import TowerConfig
from ..networks.groot import Denoiser, Groot, GrootConfig, Prefix
from ..networks.internvl import Prompt
from ..networks.qwen3_vl import rebuilt_weights
from . import qwen3_vl as qwen, vla
from .config import ACTION, CONFIG, MOST, MOST_LAYERS, MOST_LETTERS, STATE, LeRobotConfig
from .groot_steps import OLD, GrootProcessors, Seen, read_groot_processors
from .policy import MASK, TOKENS, read_weights

_BASE, _BACKBONE = "nvidia/GR00T-N1.7-3B", "nvidia/Cosmos-Reason2-2B"
_LENGTH = 64
"""Tokens of an instruction with what is after it, of a policy that none is compiled into; lerobot has no limit."""
_EMPTY = "Perform the task."
_DEFAULTS = {"backbone_embedding_dim": 2048, "input_embedding_dim": 1536, "hidden_size": 1024}
_DEFAULTS |= dict.fromkeys(("max_state_dim", "max_action_dim"), 132)
"""What lerobot takes for a width that a base model leaves out."""
OWN, UNREAD = "_groot_model.", ".language_model.norm.weight"
"""Begins the names of the weights; and the end of one that nothing reads."""
_INNER = f"{OWN}backbone.model."
_RENAMED = (
    (r"^_groot_model\.", ""),
    (r"\.layer([12])\.([Wb])$", r".fc\1.\2"),
    *qwen.DIT_LAYERS,
    (r"\.vl_self_attention\.transformer_blocks\.", ".vl_self_attention.layers."),
    (r"(\.vl_self_attention\.layers\.\d+)\.norm1\.", r"\1.layer_norm1."),
    (r"(\.vl_self_attention\.layers\.\d+)\.norm3\.", r"\1.layer_norm2."),
    (r"(\.vl_self_attention\.layers\.\d+)\.attn1\.", r"\1.self_attn."),
    (r"(\.vl_self_attention\.layers\.\d+)\.ff\.", r"\1.mlp."),
)


class Spoken(NamedTuple):
    """What is said to the language model.

    Attributes:
        name: of the backbone.
        images: that are given.
        shown: places of images in the prompt.
        plain: see ``Instruction``.
        otherwise: likewise.
    """

    name: str
    backbone: qwen.Backbone
    images: int
    shown: int
    plain: bool
    otherwise: str


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    settings, processors = shared.settings, read_groot_processors(directory, shared.features)
    _require_version(settings)
    folders = encoder_folders(options.encoders, directory)
    name = settings.text("base_model_path", _BASE, MOST_LETTERS)
    folder = language_model_folder(name, folders, "Gr00tN1d7", "base model")
    base = Settings(_DEFAULTS | read_json(folder / CONFIG), f"{folder / CONFIG}: ")
    name = base.text("model_name", _BACKBONE, MOST_LETTERS)
    backbone = qwen.find_backbone(name, folders)
    _require_whole(backbone, processors.geometry.target)
    seen = [(processors.geometry.target,) * 2] * len(processors.cameras)
    config = read_config(base, backbone.model, seen, processors.padded)
    shared, cameras = _narrowed(shared, processors, config), len(processors.cameras)
    spoken = Spoken(name, backbone, cameras, cameras * processors.frames, processors.plain, _EMPTY)
    saved = partial(read_weights, shared, options, UNREAD)
    network, told, sizes, task = rebuilt(config, spoken, saved, processors.embodiment, options.task, directory)
    encoder = vla.Gathered(shared, processors, Prefix(network, Seen(processors.geometry)), config.state, task)
    edge, given = processors.geometry.edge, {name: each for name, each in entries.items() if each is not None}
    own = Settings({**base.values, **given}, settings.where)
    last = own.number("num_timestep_buckets", 1000, 2**20)
    table = partial(vla.in_buckets, own, 4, last, processors.bounded)
    spec = vla.vla_spec(shared, processors, (edge, edge), "stretch", sizes, options, table, told)
    chunk = replace(spec.chunk, switches=_switches(shared, processors))
    spec = replace(spec, source={**spec.source, "embodiment": processors.kind}, chunk=chunk)
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def _require_version(settings: Settings) -> None:
    """Raise unless it is of N1.7."""
    path = str(settings.values.get("base_model_path")).lower()
    if settings.values.get("tokenizer_assets_repo") is not None or re.search(r"gr00t[-_]n1\.[0-6]", path):
        raise settings.error(f"this policy is {OLD}")


def _switches(shared: LeRobotConfig, processors: GrootProcessors) -> tuple[Switch, ...]:
    """What LIBERO's rule of the gripper comes to: its number g becomes -1 beyond a half, and 1 below it."""
    settings, channel = shared.settings, processors.gripper
    rule = settings.values.get("action_decode_transform") or "none"
    if rule not in ("none", "libero", "auto"):
        raise settings.refusal("action_decode_transform", "libero, none or auto")
    if rule == "none" or (rule == "auto" and processors.kind != "libero_sim"):
        return ()
    if channel is None or channel >= shared.action_dim:
        if processors.grouped:  # else LeRobot passes over it
            raise settings.error(
                "action_decode_transform is 'libero', and no group 'gripper' of actions has one number"
            )
        return ()
    if processors.relative and processors.relative[channel] is not None:
        raise settings.error("action_decode_transform is 'libero', and the gripper is relative to the state")
    return (vla.switch(processors, channel, 0.5, 1.0, -1.0),)


def _require_whole(backbone: qwen.Backbone, side: int) -> None:
    """Raise unless the backbone takes images of this side as they are."""
    resizing = qwen.read_resizing(backbone)
    if resizing(side, side) != (side, side):
        raise CheckpointError(
            f"{backbone.folder}: images reach the backbone as {side} by {side} pixels (image_target_size); expected a"
            f" multiple of {resizing.multiple} along a side, and {resizing.least} to {resizing.most} in all: otherwise"
            " it resizes them again."
        )


def rebuilt(
    config: GrootConfig,
    spoken: Spoken,
    saved: Callable[[], Mapping[str, Tensor]],
    kind: int,
    task: str | None,
    directory: Path,
) -> tuple[Groot, Instruction, dict[str, int], Tensor | None]:
    """The network, how a task is told, the sizes that ``vla_spec`` takes, and the tokens of a task that is compiled in.

    Args:
        saved: gives the weights under lerobot's names.
        kind: number of the embodiment.
    """
    prompt, told = _prompt(spoken, config.language.vocabulary)
    sizes, tokens = {"actions": config.actions, "tokens": _LENGTH, "vocabulary": config.language.vocabulary}, None
    if task is not None:
        made = task_tokens(told.line(task), spoken.name, spoken.backbone.folder, None, sizes["vocabulary"], "")
        tokens = torch.tensor([made[told.skipped :]])
    weights = _weights(saved(), config, kind, directory)
    network = filled(lambda: Groot(config, prompt), weights, "config.json, or the base model's,", directory)
    return network, told, sizes, tokens


def read_config(base: Settings, model: Settings, seen: list[tuple[int, int]], padded: tuple[int, int]) -> GrootConfig:
    """Sizes and variant, of the entries of the base model and of its backbone.

    Args:
        seen: height and width of every image that the backbone sees.
        padded: numbers of a state and of an action.
    """
    dit = vla.part_of(base, "diffusion_model_cfg")
    language = qwen.read_language(model, base.number("select_layer", 16), seen)
    layers, width = _tower(dit), language.text.width
    mixing = vla.part_of(base, "vl_self_attention_cfg") if base.values.get("vl_self_attention_cfg") else None
    mixed = _tower(mixing) if mixing is not None and mixing.values.get("num_layers", 0) else None
    (state, actions), out = padded, dit.number("output_dim", 26, MOST)
    base.require(backbone_embedding_dim=width, input_embedding_dim=layers.hidden_size, hidden_size=out)
    base.require(state_history_length=1, max_state_dim=state, max_action_dim=actions)
    if mixed is not None and mixed.hidden_size != width:
        raise base.refusal("vl_self_attention_cfg", f"heads of {width} channels together")
    itself, apart = dit.flag("interleave_self_attention", False), base.flag("use_alternate_vl_dit", True)
    every = 2 * base.number("attend_text_every_n_blocks", 2, MOST) if apart else 1
    if apart and not itself:
        raise dit.refusal("interleave_self_attention", "true, with use_alternate_vl_dit")
    looks = ("itself" if itself and i % 2 else "images" if i % every else "words" for i in range(MOST_LAYERS))
    horizon = base.number("action_horizon", 40, MOST)
    places = base.number("max_seq_len", 1024, MOST) if base.flag("add_pos_embed", True) else None
    if places is not None and places < horizon:
        raise base.refusal("max_seq_len", f"at least the {horizon} actions of a chunk")
    return GrootConfig(
        language=language,
        mixing=mixed,
        normed=base.flag("use_vlln", True),
        layers=layers,
        out=out,
        state=state,
        actions=actions,
        horizon=horizon,
        places=places,
        looks=tuple(looks)[: layers.num_hidden_layers],
        apart=apart,
    )


def _tower(own: Settings) -> TowerConfig:
    """Layers of diffusers, of the head or of what mixes the language model's features."""
    own = Settings({"positional_embeddings": "sinusoidal", **own.values}, own.where)
    own.require(positional_embeddings=None, activation_fn="gelu-approximate", attention_bias=True)
    own.require(norm_type="ada_norm", norm_elementwise_affine=False)
    heads = own.number("num_attention_heads", 8, MOST)
    width = heads * own.number("attention_head_dim", 64, MOST)
    return TowerConfig(
        hidden_size=width,
        intermediate_size=4 * width,
        num_hidden_layers=own.number("num_layers", 12, MOST_LAYERS),
        num_attention_heads=heads,
        hidden_act="gelu_pytorch_tanh",
        layer_norm_eps=vla.positive_number(own, "norm_eps", 1e-5),
    )


def _narrowed(shared: LeRobotConfig, processors: GrootProcessors, config: GrootConfig) -> LeRobotConfig:
    """Cameras that are shown, in their order, and the chunk that the head makes."""
    features = {key: shared.features[key] for key in (STATE, *processors.cameras, ACTION)}
    for name, own in ((STATE, config.state), (ACTION, config.actions)):
        if (count := features[name][1][0]) > own:
            raise shared.settings.error(f"{name} has {count} numbers; expected {own} at most, which the head has")
    executed = min(shared.n_action_steps, shared.horizon, config.horizon, processors.executed or config.horizon)
    return replace(shared, features=features, horizon=config.horizon, n_action_steps=executed)


def _prompt(spoken: Spoken, vocabulary: int) -> tuple[Prompt, Instruction]:
    """What is before each image, and how a task is told."""
    name, backbone, images, shown, plain, otherwise = spoken
    around = (qwen.IMAGE * shown, qwen.END)
    told = Instruction(TOKENS, MASK, True, (qwen.TURN,), around=around, plain=plain, otherwise=otherwise)
    between, told = told_after(told, name, backbone.folder, vocabulary, backbone.image, shown)
    return Prompt(between, images), told


def _weights(saved: Mapping[str, Tensor], config: GrootConfig, kind: int, directory: Path) -> Mapping[str, Tensor]:
    """The weights under the names of ``Groot``; of those that each embodiment has, those of its own."""
    found = dict[str, Tensor]()
    others, backbone = qwen.of_backbone(saved, _INNER, partial(rebuilt_weights, config=config.language))
    for own, value in others.items():
        name = renamed(own, _RENAMED)
        if name.endswith((".W", ".b")):
            end, axes = (".weight", 3) if name.endswith(".W") else (".bias", 2)
            if value.ndim != axes or len(value) <= kind:
                raise CheckpointError(f"{directory}: weight {own} has no part {kind}, of the embodiment.")
            name, value = name[:-2] + end, value[kind].T.contiguous() if axes == 3 else value[kind].clone()
        found[name] = value
    return found | backbone
