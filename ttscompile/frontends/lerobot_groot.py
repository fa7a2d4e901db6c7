"""LeRobot's ``groot``, GR00T N1.7: its directory to module and ``PolicySpec``; cameras, words, state to robot actions.

Neither lerobot nor transformers is needed. Sizes are those of the base model's and of its backbone's folders, which
lerobot needs, too. Source: ``GrootPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..core.spec import Instruction, PolicySpec, SamplerTable
from ..errors import CheckpointError, SpecError
from . import lerobot_vla as vla
from .clip import ACTIVATIONS, TowerConfig
from .encoded import EncodedDenoiser
from .families import LoadOptions
from .groot import Denoiser, Groot, GrootConfig, Prefix
from .instruction import encoder_folders, language_model_folder, task_tokens, told_after
from .internvl import Prompt
from .lerobot_config import ACTION, CONFIG, MOST, STATE, LeRobotConfig
from .lerobot_groot_steps import OLD, GrootProcessors, Seen, read_groot_processors
from .lerobot_policy import MASK, TOKENS, read_weights
from .qwen3_vl import Qwen3VLConfig, QwenVisionConfig, rebuilt_weights
from .saved_weights import filled, renamed
from .settings import Settings, read_json

_BASE, _BACKBONE = "nvidia/GR00T-N1.7-3B", "nvidia/Cosmos-Reason2-2B"
_MOST_LAYERS, _MOST_VOCABULARY, _MOST_LETTERS, _MOST_PATCHES = 512, 2**20, 400, 2**22
_LENGTH = 64
"""Tokens of an instruction with what is after it, of a policy that none is compiled into; lerobot has no limit."""
_TURN, _IMAGE, _END = "<|im_start|>user", "<|vision_start|><|image_pad|><|vision_end|>", "<|im_end|>"
"""What the chat template of Qwen3-VL writes; of an image's tokens one stands for all."""
_EMPTY = "Perform the task."
_DEFAULTS = {"backbone_embedding_dim": 2048, "input_embedding_dim": 1536, "hidden_size": 1024}
_DEFAULTS |= dict.fromkeys(("max_state_dim", "max_action_dim"), 132)
"""What lerobot takes for a width that a base model leaves out."""
_INNER, _EMBEDDING = "_groot_model.backbone.model.", "backbone.language_model.embed_tokens.weight"
_RENAMED = (
    (r"^_groot_model\.", ""),
    (r"\.layer([12])\.([Wb])$", r".fc\1.\2"),
    (r"\.timestep_embedder\.", "."),
    (r"\.attn1\.to_([qkv])\.", r".attn1.\1_proj."),
    (r"\.attn1\.to_out\.0\.", ".attn1.out_proj."),
    (r"\.ff\.net\.0\.proj\.", ".ff.fc1."),
    (r"\.ff\.net\.2\.", ".ff.fc2."),
    (r"\.norm1\.linear\.", ".scale."),
    (r"\.vl_self_attention\.transformer_blocks\.", ".vl_self_attention.layers."),
    (r"(\.vl_self_attention\.layers\.\d+)\.norm1\.", r"\1.layer_norm1."),
    (r"(\.vl_self_attention\.layers\.\d+)\.norm3\.", r"\1.layer_norm2."),
    (r"(\.vl_self_attention\.layers\.\d+)\.attn1\.", r"\1.self_attn."),
    (r"(\.vl_self_attention\.layers\.\d+)\.ff\.", r"\1.mlp."),
)


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, entries, options)
    settings, processors = shared.settings, read_groot_processors(directory, shared.features)
    _require_version(settings)
    folders = encoder_folders(options.encoders, directory)
    name = settings.text("base_model_path", _BASE, _MOST_LETTERS)
    folder = language_model_folder(name, folders, "Gr00tN1d7", "base model")
    base = Settings(_DEFAULTS | read_json(folder / CONFIG), f"{folder / CONFIG}: ")
    name = base.text("model_name", _BACKBONE, _MOST_LETTERS)
    folder = language_model_folder(name, folders, "qwen3_vl", "backbone")
    model = Settings(read_json(folder / CONFIG), f"{folder / CONFIG}: ")
    _require_files(folder, processors, model)
    config = read_config(base, model, processors)
    shared = _narrowed(shared, processors, config)
    prompt, told = _prompt(processors, name, folder, model, config.language.vocabulary)
    sizes, task = {"actions": config.actions, "tokens": _LENGTH, "vocabulary": config.language.vocabulary}, None
    if options.task is not None:
        tokens = task_tokens(told.line(options.task), name, folder, None, sizes["vocabulary"], "")
        task = torch.tensor([tokens[told.skipped :]])
    weights = _weights(shared, options, config, processors.embodiment)
    network = filled(lambda: Groot(config, prompt), weights, "config.json, or the base model's,", directory)
    encoder = vla.Gathered(shared, processors, Prefix(network, Seen(processors.geometry)), config.state, task)
    edge, own = processors.geometry.edge, {name: each for name, each in entries.items() if each is not None}
    table = partial(_sampler, Settings({**base.values, **own}, settings.where), processors.bounded)
    spec = vla.vla_spec(shared, processors, (edge, edge), "stretch", sizes, options, table, told)
    spec = replace(spec, source={**spec.source, "embodiment": processors.kind})
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def _require_version(settings: Settings) -> None:
    """Raise unless it is of N1.7, and actions are left as they are."""
    path = str(settings.values.get("base_model_path")).lower()
    if settings.values.get("tokenizer_assets_repo") is not None or re.search(r"gr00t[-_]n1\.[0-6]", path):
        raise settings.error(f"this policy is {OLD}")
    if settings.values.get("action_decode_transform") not in (None, "none"):
        rule = "none: that the gripper's number g becomes -sign(2 g - 1) is not compiled, and is the robot's to do"
        raise settings.refusal("action_decode_transform", rule)


def _require_files(folder: Path, processors: GrootProcessors, model: Settings) -> None:
    """Raise unless images and words come to the backbone as is rebuilt here."""
    settings = Settings(read_json(folder / (name := "preprocessor_config.json")), f"{folder / name}: ")
    vision, half = vla.part_of(model, "vision_config"), [0.5] * 3
    patch, merge = vision.number("patch_size", 16, MOST), vision.number("spatial_merge_size", 2, MOST)
    own = Settings({"patch_size": None, "merge_size": None, **settings.values}, settings.where)
    own.require(patch_size=patch, merge_size=merge, image_mean=half, image_std=half, do_normalize=True, do_rescale=True)
    side, size = processors.geometry.target, vla.part_of(settings, "size")
    least, most = (size.number(f"{entry}_edge", most=2**31) for entry in ("shortest", "longest"))
    if side % (patch * merge) or not least <= side**2 <= most:
        raise CheckpointError(
            f"{folder}: images reach the backbone as {side} by {side} pixels (image_target_size); expected a multiple"
            f" of {patch * merge} along a side, and {least} to {most} in all: otherwise it resizes them again."
        )
    path, entry = folder / "chat_template.jinja", read_json(folder / "tokenizer_config.json").get("chat_template")
    template = path.read_text("utf-8", "replace")[:_MOST_VOCABULARY] if path.is_file() else entry
    wanted, found = ("<|im_start|>", _IMAGE, "<|im_end|>"), str(template)
    if template is not None and (not all(word in found for word in wanted) or "helpful assist" in found):
        expected = f"Qwen3-VL's: {' '.join(wanted)}, and no words of its own"
        raise CheckpointError(f"{folder}: its chat template is another one than is rebuilt here; expected {expected}.")


def read_config(base: Settings, model: Settings, processors: GrootProcessors) -> GrootConfig:
    """Sizes and variant, of the entries of the base model and of its backbone."""
    language, dit = _read_language(base, model, processors.geometry.target), vla.part_of(base, "diffusion_model_cfg")
    layers, width = _tower(dit), language.text.width
    mixing = vla.part_of(base, "vl_self_attention_cfg") if base.values.get("vl_self_attention_cfg") else None
    mixed = _tower(mixing) if mixing is not None and mixing.values.get("num_layers", 0) else None
    (state, actions), out = processors.padded, dit.number("output_dim", 26, MOST)
    base.require(backbone_embedding_dim=width, input_embedding_dim=layers.hidden_size, hidden_size=out)
    base.require(state_history_length=1, max_state_dim=state, max_action_dim=actions)
    if mixed is not None and mixed.hidden_size != width:
        raise base.refusal("vl_self_attention_cfg", f"heads of {width} channels together")
    itself, apart = dit.flag("interleave_self_attention", False), base.flag("use_alternate_vl_dit", True)
    every = 2 * base.number("attend_text_every_n_blocks", 2, MOST) if apart else 1
    if apart and not itself:
        raise dit.refusal("interleave_self_attention", "true, with use_alternate_vl_dit")
    looks = ("itself" if itself and i % 2 else "images" if i % every else "words" for i in range(_MOST_LAYERS))
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
        num_hidden_layers=own.number("num_layers", 12, _MOST_LAYERS),
        num_attention_heads=heads,
        hidden_act="gelu_pytorch_tanh",
        layer_norm_eps=vla.positive_number(own, "norm_eps", 1e-5),
    )


def _read_language(base: Settings, model: Settings, side: int) -> Qwen3VLConfig:
    """Of the backbone's entries; defaults are those of transformers."""
    image, text = vla.part_of(model, "vision_config"), vla.part_of(model, "text_config")
    rope = vla.rope_of(text, 5e5)
    image.require(in_channels=3, out_hidden_size=text.values.get("hidden_size"))
    text.require(hidden_act="silu", attention_bias=False)
    rope.require(rope_type="default", mrope_interleaved=True)
    depth, table = image.number("depth", 27, _MOST_LAYERS), image.number("num_position_embeddings", 2304, _MOST_PATCHES)
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
        image_size=side,
        patch_size=image.number("patch_size", 16),
        merge=image.number("spatial_merge_size", 2, MOST),
        table=math.isqrt(table),
        stacked=tuple(stacked),
    )
    if vision.hidden_size // vision.num_attention_heads % 4:
        raise image.refusal("num_heads", "heads of a multiple of 4 channels")
    layers = min(text.number("num_hidden_layers", 32, _MOST_LAYERS), base.number("select_layer", 16))
    language = replace(vla.read_language(text, layers, 128), normed=True)
    vocabulary = text.number("vocab_size", 151936, _MOST_VOCABULARY)
    angle = vla.positive_number(rope, "rope_theta", 5e5)
    return Qwen3VLConfig(vision, language, vocabulary, (sections[1], sections[2]), angle)


def _narrowed(shared: LeRobotConfig, processors: GrootProcessors, config: GrootConfig) -> LeRobotConfig:
    """Cameras that are shown, in their order, and the chunk that the head makes."""
    features = {key: shared.features[key] for key in (STATE, *processors.cameras, ACTION)}
    for name, own in ((STATE, config.state), (ACTION, config.actions)):
        if (count := features[name][1][0]) > own:
            raise shared.settings.error(f"{name} has {count} numbers; expected {own} at most, which the head has")
    executed = min(shared.n_action_steps, shared.horizon, config.horizon, processors.executed or config.horizon)
    return replace(shared, features=features, horizon=config.horizon, n_action_steps=executed)


def _prompt(
    processors: GrootProcessors, name: str, folder: Path, model: Settings, vocabulary: int
) -> tuple[Prompt, Instruction]:
    """What is before each image, and how a task is told."""
    shown = len(processors.cameras) * processors.frames
    around = (_IMAGE * shown, _END)
    told = Instruction(TOKENS, MASK, True, (_TURN,), around=around, plain=processors.plain, otherwise=_EMPTY)
    image = model.number("image_token_id", 151655, _MOST_VOCABULARY)
    between, told = told_after(told, name, folder, vocabulary, image, shown)
    return Prompt(between, len(processors.cameras)), told


def _sampler(settings: Settings, bounded: bool, options: LoadOptions) -> SamplerTable:
    """From noise to actions, which may be clipped at the end."""
    table = vla.in_buckets(settings, 4, settings.number("num_timestep_buckets", 1000, 2**20), options)
    if not bounded:
        return table
    if table.name != "euler":
        raise SpecError(f"sampler {table.name}: the actions of this policy are clipped at the end; expected euler.")
    last = np.arange(table.steps) == table.steps - 1
    share = {"x0_to_next": last, "sample_to_next": ~last, "out_to_next": np.where(last, 0, table.out_to_next)}
    return replace(table, clip=1.0, **{name: each.astype(np.float32) for name, each in share.items()})


def _weights(shared: LeRobotConfig, options: LoadOptions, config: GrootConfig, kind: int) -> Mapping[str, Tensor]:
    """The weights under the names of ``Groot``; of those that each embodiment has, those of its own."""
    found, inner = dict[str, Tensor](), dict[str, Tensor]()
    for saved, value in read_weights(shared, options, ".language_model.norm.weight").items():
        if saved == f"{_INNER}lm_head.weight":  # the same numbers as the embedding, of which a file may have either
            found.setdefault(_EMBEDDING, value)
            continue
        if saved.startswith(_INNER):
            inner[saved.removeprefix(f"{_INNER}model.")] = value
            continue
        name = renamed(saved, _RENAMED)
        if name.endswith((".W", ".b")):
            own, axes = (".weight", 3) if name.endswith(".W") else (".bias", 2)
            if value.ndim != axes or len(value) <= kind:
                raise CheckpointError(f"{shared.directory}: weight {saved} has no part {kind}, of the embodiment.")
            name, value = name[:-2] + own, value[kind].T.contiguous() if axes == 3 else value[kind].clone()
        found[name] = value
    return found | {f"backbone.{name}": value for name, value in rebuilt_weights(inner, config.language).items()}
