"""Evo-1 as its authors save it: a directory to module and ``PolicySpec``; cameras, words and state to robot actions.

Neither their code nor transformers is needed. Sizes of the language model, InternVL3, are those of its folder, which
that code needs, too. Their attention is FlashAttention, which gives zeros for what a mask leaves out; their head looks
at that as well. Their server computes in bfloat16, and here all is float32.

Source: ``Evo1_server.py`` of MINT-SJTU/Evo-1 at 1bf31c4.
"""

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ttscompile.core.spec import PolicySpec
from ttscompile.core.tokenizer import FILE
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled, left_out, require_memory_for
from ttscompile.frontends.settings import Settings, read_json

from .groot import vector
from .groot_pictures import SIZE, as_bytes, read_sizes
from .instruction import encoder_folders, find_encoder, language_model_folder, task_tokens
from .lerobot import evo1 as shared, vla
from .lerobot.config import ACTION, CONFIG, MOST_LETTERS, MOST_STEPS, STATE, LeRobotConfig
from .lerobot.processors import STATISTICS, Processors, Statistics
from .networks.evo1 import TIMES, Denoiser, Evo1, Evo1Config, PaddedPrefix
from .networks.internvl import Prompt
from .opencv_area import linear_resized

_WEIGHTS = {"mp_rank_00_model_states.pt": "module", "checkpoint.pt": "model_state_dict"}
"""The entry of each file that holds them. DeepSpeed writes the first."""
_SAVED, _CAMERAS, _EPSILON = "norm_stats.json", ("image_1", "image_2", "image_3"), 1e-8
_NAME, _IMAGE, _PADDING = "OpenGVLab/InternVL3-1B", "<IMG_CONTEXT>", "<|endoftext|>"
_SIDE, _NUMBERS, _STEPS = 448, 24, 50
"""Pixels, numbers of a state or an action, and steps of their server, whatever the configuration says."""
_MODES = {"bounds": "MIN_MAX", "bounds_q99": "QUANTILES", "normal": "MEAN_STD"}
"""LeRobot's names of their ``normalization_type``."""
_SAME = "action_head embed_dim hidden_dim state_hidden_dim num_heads num_layers num_categories".split()
"""Entries that LeRobot has, too."""
_RENAMED = (
    (r"^embedder\.model\.vision_model\.", "embedder.vision_tower."),
    (r"\.class_embedding$", ".cls_token"),
    (r"\.patch_embedding\.", ".projection."),
    (r"\.position_embedding$", ".position_embeddings"),
    (r"(\.encoder\.layers\.\d+)\.norm(\d)\.", r"\1.layer_norm\2."),
    (r"(\.encoder\.layers\.\d+)\.attn\.qkv\.", r"\1.self_attn.qkv."),
    (r"(\.encoder\.layers\.\d+)\.attn\.proj\.", r"\1.self_attn.out_proj."),
    (r"(\.encoder\.layers\.\d+)\.ls(\d)$", r"\1.lambda_\2"),
    (r"^embedder\.model\.mlp1\.0\.", "embedder.multi_modal_projector.layer_norm."),
    (r"^embedder\.model\.mlp1\.1\.", "embedder.multi_modal_projector.linear_1."),
    (r"^embedder\.model\.mlp1\.3\.", "embedder.multi_modal_projector.linear_2."),
    (r"^embedder\.model\.language_model\.model\.", "embedder.language_model."),
)


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    base = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: ")
    horizon, settings = _horizon(base), replace(base, values=_as_lerobot(base))
    name, folder = _language_model(base, directory, options.encoders)
    model = _as_transformers(Settings(read_json(folder / CONFIG), f"{folder / CONFIG}: "))
    source, own = _robot(directory, base)
    state, action = (_statistics(own.part(part), base) for part in (STATE, ACTION))
    sizes = _cameras(directory, base, options)
    features: dict[str, tuple[str, tuple[int, ...]]] = {STATE: ("STATE", (len(state.first),))}
    features |= {key: ("VISUAL", (3, *size)) for key, size in sizes.items()}
    features[ACTION] = ("ACTION", (len(action.first),))
    around = LeRobotConfig(directory, settings, features, 1, horizon, horizon)
    config = shared.read_config(around, model)
    numbers = vla.padded_size(settings, "max_state_dim", len(state.first), _NUMBERS)
    image, padding = (_token(each, name, folder, config) for each in (_IMAGE, _PADDING))
    between, told, length, task = shared.spoken(settings, config, name, folder, image, len(_CAMERAS), options.task)
    weights = shared.as_named(_weights(directory, config), settings, config, model, _RENAMED)
    prompt, black = Prompt(between, len(sizes)), len(_CAMERAS) - len(sizes)
    network = filled(lambda: Evo1(config, prompt), weights, "config.json, or the language model's,", directory)
    with torch.no_grad():
        unseen = network.embedder.left_out(padding, -torch.ones(3, _SIDE, _SIDE) if black else None)
    shorter = 0 if task is None else length - task.shape[1]
    prefix = PaddedPrefix(network, _Pictures(list(sizes.values())), unseen, shorter, black)
    ways = Processors({STATE: state}, action, {STATE: "state"}, {})
    encoder = vla.Gathered(around, ways, prefix, numbers, task)
    table = partial(vla.in_buckets, settings, _STEPS, TIMES - 1, False)
    widths = {"actions": config.max_action_dim, "tokens": length, "vocabulary": config.language.vocabulary}
    spec = vla.vla_spec(around, ways, None, "stretch", widths, options, table, told)
    spec = replace(spec, noise="uniform", source={**spec.source, "format": "evo1", "policy": "Evo-1", **source})
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The language model's tokenizer, if it is on this machine; see ``Family``."""
    base = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: ")
    return _language_model(base, directory, encoders)[1] / FILE


def _horizon(base: Settings) -> int:
    """Actions of a chunk. Raises CheckpointError: the network is another than their server runs."""
    base.require(return_cls_only=False, vision_masked=False)
    for name, default in (("per_action_dim", 7), ("state_dim", 7)):
        if base.values.get(name, default) != _NUMBERS:
            raise base.refusal(name, f"{_NUMBERS}, as many as the server of its authors has", default)
    horizon = base.number("horizon", 16, MOST_STEPS)
    if base.values.get("action_horizon") not in (None, horizon):
        raise base.refusal("action_horizon", f"null, or {horizon}, the horizon")
    return horizon


def _as_lerobot(base: Settings) -> dict[str, Any]:
    """What LeRobot's entries would say; its defaults are the same."""
    return {"type": "evo1", **{name: base.values[name] for name in _SAME if name in base.values}}


def _language_model(base: Settings, directory: Path, encoders: str | os.PathLike[str] | None) -> tuple[str, Path]:
    """Name and folder of InternVL3, as transformers has it, or else as OpenGVLab does."""
    name, places = base.text("vlm_name", _NAME, MOST_LETTERS), encoder_folders(encoders, directory)
    folder = find_encoder(f"{name}-hf", places, "internvl") or language_model_folder(name, places, "internvl")
    if not (folder / FILE).is_file():
        raise CheckpointError(
            f"{folder}: no {FILE}; expected that of InternVL3. Copy it from {_NAME}-hf, which has the same tokens."
        )
    return name, folder


def _as_transformers(model: Settings) -> Settings:
    """The entries of OpenGVLab's InternVL3, under the names of transformers; others stay as they are."""
    if model.values.get("model_type") != "internvl_chat":
        return model
    image, text = (vla.part_of(model, each) for each in ("vision_config", "llm_config"))
    model.require(select_layer=-1, ps_version="v2", force_image_size=_SIDE)
    image.require(qk_normalization=False)
    ratio = vla.positive_number(model, "downsample_ratio", 0.5)
    patches = image.number("image_size", _SIDE) // image.number("patch_size", 14)
    entries = {
        "vision_config": {**image.values, "attention_bias": image.flag("qkv_bias", False)},
        "text_config": text.values,
        "image_seq_length": int(patches**2 * ratio**2),
        "downsample_ratio": ratio,
    }
    return replace(model, values=entries)


def _robot(directory: Path, base: Settings) -> tuple[dict[str, str], Settings]:
    """What ``norm_stats.json`` calls the robot, and its statistics: those of one data set, or of all."""
    found = Settings(read_json(directory / _SAVED), f"{directory / _SAVED}: ")
    arm = _chosen(base, "arm_key", found)
    own = found.part(arm)
    if not own.values.keys().isdisjoint((STATE, ACTION)):  # as their code saved them until April 2026
        return {"arm": arm}, own
    dataset = _chosen(base, "dataset_key", own)
    return {"arm": arm, "dataset": dataset}, own.part(dataset)


def _chosen(base: Settings, entry: str, found: Settings) -> str:
    """One of the entries that are there: the only one, or which ``config.json`` names."""
    names = sorted(found.values)
    name = base.values.get(entry, names[0] if len(names) == 1 else None)
    if name not in names:
        told = f"{_SAVED} has {', '.join(names)[:800] or 'none'}, and {entry} is {name!r:.80}"
        raise base.error(f'{told}. Write which is yours into this file: "{entry}": "{(names or ["NAME"])[0]}"')
    return str(name)


def _statistics(own: Settings, base: Settings) -> Statistics:
    """Of a state or of actions, whose ranges are widened a little, in float32."""
    mode = _MODES[base.choice("normalization_type", *_MODES)]
    if mode == "QUANTILES" and not set(STATISTICS[mode]) <= own.values.keys():
        mode = "MIN_MAX"
    ends = STATISTICS[mode]
    first, second = (vector(own, name).to(torch.float32) for name in ends)
    if len(first) != len(second):
        raise own.error(f"{' and '.join(ends)} have {len(first)} and {len(second)} numbers; expected as many")
    averaged = mode == "MEAN_STD"
    width = ((second if averaged else second - first) + _EPSILON).double()
    first = first.double()
    return Statistics(mode, first, width if averaged else first + width, 0.0, clipped=not averaged)


def _cameras(directory: Path, base: Settings, options: LoadOptions) -> Mapping[str, tuple[int, int]]:
    """Height and width of the pictures that the robot has: the first ones of three."""
    kept = vla.kept_cameras(directory, _CAMERAS, options)
    if tuple(kept) != _CAMERAS[: len(kept)]:
        raise CheckpointError(
            f"{directory}: without the cameras {', '.join(sorted(set(_CAMERAS) - set(kept)))} there is {kept[-1]}; in"
            f" training the first pictures were there. Leave {_CAMERAS[-1]} out, or the last two."
        )
    default = {} if type(base.values.get(SIZE)) is not int else {SIZE: [_SIDE, _SIDE]}
    return read_sizes(replace(base, values={**base.values, **default}), kept, (_SIDE, _SIDE))


def _token(word: str, name: str, folder: Path, config: Evo1Config) -> int:
    """The token of a word that is one."""
    found = task_tokens(word, name, folder, None, config.language.vocabulary, "")
    if len(found) != 1:
        raise CheckpointError(f"{folder / FILE}: {word} has {len(found)} tokens; expected one. It is not InternVL3's.")
    return found[0]


def _weights(directory: Path, config: Evo1Config) -> dict[str, Tensor]:
    """Under their names."""
    file = next((each for each in _WEIGHTS if (directory / each).is_file()), next(iter(_WEIGHTS)))
    path, entry = directory / file, _WEIGHTS[file]
    saved = read_checkpoint(path, mapped=True).get(entry)
    if not isinstance(saved, Mapping):
        raise CheckpointError(f"{path}: no entry {entry!r} of weights; expected what Evo-1's training saved.")
    found = {str(name): value for name, value in saved.items() if not left_out(str(name), shared.unread(config))}
    tensors = (value for value in found.values() if isinstance(value, Tensor))
    require_memory_for(path, ((each.numel(), each.dtype == torch.float32) for each in tensors))
    return as_float32(found, f"{path}: ")


class _Pictures(nn.Module):
    """Pictures in -1..1, of these heights and widths, as OpenCV resizes their bytes."""

    def __init__(self, sizes: list[tuple[int, int]]) -> None:
        super().__init__()
        self.resizing = nn.ModuleList(linear_resized(size, (_SIDE, _SIDE)) for size in sizes)

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """See the class."""
        pairs = zip(self.resizing, images, strict=True)
        return [resize(as_bytes(image)) / 127.5 - 1 for resize, image in pairs]
