"""Adapters (LoRA, arXiv 2106.09685) that PEFT saved in the directory of a LeRobot policy, merged into their base."""

import math
import os
import re
from pathlib import Path
from typing import Any

import torch

from ttscompile.core.paths import HUB, on_hub
from ttscompile.errors import CheckpointError, HubError
from ttscompile.frontends.refusals import MERGE
from ttscompile.frontends.saved_weights import as_float32, left_out, read_tensors
from ttscompile.frontends.settings import Settings, read_json
from ttscompile.hub import fetch_checkpoint

from .config import WEIGHTS

Tensors = dict[str, torch.Tensor]
ADAPTER, CHANGES = "adapter_config.json", "adapter_model.safetensors"
_KNOWN = set(
    "peft_type base_model_name_or_path revision r lora_alpha use_rslora rank_pattern alpha_pattern modules_to_save bias"
    " use_dora init_lora_weights auto_mapping peft_version task_type inference_mode lora_dropout target_modules"
    " exclude_modules layers_to_transform layers_pattern eva_config megatron_core qalora_group_size".split()
)  # entries that are read, or that change nothing once there are weights; any other one has to be empty
_LAYER = re.compile(r"base_model\.model\.(.+)\.(lora_[AB]\.weight|lora_magnitude_vector)")
_COPY = re.compile(r"\.(modules_to_save|original_module)\..*bias$")  # of what is saved whole, where all biases are, too
_PATTERN = re.compile(r"(?:[\w.|^$-]|\\[.d]|\.\*(?!.*\*.*\*))+")  # what cannot take for ever to match
_LEVELS = re.compile(r"\b(?:model|vision_model|text_model)\.")  # other versions of transformers have them elsewhere


def read_adapter(directory: Path, policy: Settings) -> Settings | None:
    """The adapter's entries; None for a whole policy, which one with weights is unless its ``use_peft`` is true."""
    if not (directory / ADAPTER).is_file() or ((directory / WEIGHTS).is_file() and not policy.flag("use_peft", False)):
        return None
    settings = Settings(read_json(directory / ADAPTER), f"{directory / ADAPTER}: ", MERGE)
    settings.choice("peft_type", "LORA")
    if settings.values.get("init_lora_weights") not in (None, True, False, "gaussian", "eva", "orthogonal"):
        raise settings.refusal("init_lora_weights", "true, gaussian, eva or orthogonal: others change the base first")
    for name, kind in (("modules_to_save", list), ("rank_pattern", dict), ("alpha_pattern", dict)):
        rows = settings.values.get(name) or kind()
        if not isinstance(rows, kind) or not all(isinstance(each, str) and _PATTERN.fullmatch(each) for each in rows):
            raise settings.refusal(name, f"a {kind.__name__} of names, in which .* may stand twice")
    if unknown := sorted(name for name, value in settings.values.items() if value and name not in _KNOWN):
        raise settings.refusal(unknown[0], "none, since it is not merged here")
    return settings


def find_base(settings: Settings, given: str | os.PathLike[str] | None) -> Path:
    """The directory of the policy that is adapted: what the caller gave, or what the configuration names."""
    named, at = str(given or settings.values.get("base_model_name_or_path") or ""), settings.values.get("revision")
    where = f"{settings.where}the base is {named or None!a:.300}"
    remedy = f"Give the base policy, a directory with {WEIGHTS} or hf://ORG/NAME, with --base (base= in Python)."
    if given is None and re.fullmatch(r"\w[\w.-]{,95}/[\w.-]{1,96}", named) and not Path(named).exists():
        named = HUB + named + (f"@{at}".replace("/", "%2F") if at else "")
    try:
        path = fetch_checkpoint(named).path if on_hub(named) else Path(named)
        if named and (path / WEIGHTS).is_file():
            return path
    except (HubError, OSError) as error:  # OSError: of a name that no file system has
        raise CheckpointError(f"{where}: {error} {remedy}") from error
    raise CheckpointError(f"{where}: expected a directory with {WEIGHTS}; there is none. {remedy}")


def merged(directory: Path, settings: Settings, base: Tensors, without: tuple[str, ...]) -> Tensors:
    """The base, float32 by name, with the weights in their place that PEFT's ``merge_and_unload`` makes."""
    where, changes, done = Settings({}, f"{directory / CHANGES}: ", MERGE), dict[str, Tensors](), set[str]()
    kept = {each: any(each in one for one in without) for each in settings.values.get("modules_to_save") or ()}
    biases = settings.choice("bias", "none", "all", "lora_only") != "none"
    saved = {key: value for key, value in read_tensors(directory / CHANGES).items() if not left_out(key, without)}
    for key, value in as_float32({key: saved[key] for key in saved if not _COPY.search(key)}, where.where).items():
        part = _LAYER.fullmatch(key)
        name = f"{part[1]}.weight" if part else key.removeprefix("base_model.model.").replace(".base_layer.", ".")
        modules = [each for each in kept if f"{each}." in name and not part]
        if not part and not modules and not (biases and name.endswith(".bias")):
            raise where.error(f"found {key:.300}; expected lora_A and lora_B of layers, modules_to_save and biases")
        kept |= dict.fromkeys(modules, True)
        changes.setdefault(name, {})[part[2] if part else ""] = value
    if not changes or not all(kept.values()):
        raise where.error(f"found {len(changes)} changes and of modules_to_save {kept}; expected weights of each")
    for name, parts in changes.items():
        if not left_out(name, without):  # which the policy does not compute
            own = [name] if name in base else [each for each in base if _LEVELS.sub("", each) == _LEVELS.sub("", name)]
            if len(own) != 1 or own[0] in done:
                raise where.error(f"{name:.300} is no weight of the base, or twice; expected the adapter of this base")
            done.add(own[0])
            # A whole weight of another shape is what ``require_weights`` refuses.
            base[own[0]] = parts[""] if parts.keys() == {""} else _layer(settings, name, base[own[0]], parts)
    return base


def _layer(settings: Settings, name: str, own: torch.Tensor, parts: Tensors) -> torch.Tensor:
    """The weight ``[out, in, ...]`` of a linear or convolutional layer with its change; DoRA: arXiv 2402.09353."""
    module, dora = name.removesuffix(".weight"), settings.flag("use_dora", False)
    rank = int(_number(settings, "r", "rank_pattern", module))
    expected = {"lora_A.weight": [rank, *own.shape[1:]], "lora_B.weight": [len(own), rank, *[1] * (own.dim() - 2)]}
    expected |= {"lora_magnitude_vector": [len(own)]} if dora else {}
    if (found := {part: list(value.shape) for part, value in sorted(parts.items())}) != expected or own.dim() < 2:
        raise settings.error(f"{module:.300} of {CHANGES} has {found}; expected {expected}")
    scaling = _number(settings, "lora_alpha", "alpha_pattern", module)
    scaling /= math.sqrt(rank) if settings.flag("use_rslora", False) else rank
    change = parts["lora_B.weight"].double().flatten(1) @ parts["lora_A.weight"].double().flatten(1)
    rows = own.double().flatten(1) + scaling * change
    if dora:
        rows *= parts["lora_magnitude_vector"].double()[:, None] / rows.norm(dim=1, keepdim=True)
    return rows.reshape(own.shape).float()


def _number(settings: Settings, name: str, patterns: str, module: str) -> float:
    """``r`` or ``lora_alpha``: of the first pattern that matches the end of the module's name, or that of all."""
    rows = settings.values.get(patterns) or {}
    value: Any = next((rows[key] for key in rows if re.match(rf"(.*\.)?({key})$", module)), settings.values.get(name))
    if type(value) not in ((int,) if name == "r" else (int, float)) or not 0 < value <= 2**20:
        raise settings.error(f"{name} of {module:.300} is {value!r:.80}; expected a positive number")
    return float(value)
