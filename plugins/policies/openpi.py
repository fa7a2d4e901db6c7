"""openpi's pi0 and pi0.5 as openpi saves them: a directory to module and ``PolicySpec``.

What openpi does around the network with what it saves is here: statistics, prompt, images, padding. What a robot's code
does around that (``data_transforms`` of the training's config) is not in a checkpoint. Source:
Physical-Intelligence/openpi at 15a9616, ``policies/policy_config.py``, ``transforms.py``, ``models/tokenizer.py``.
"""

from __future__ import annotations

import os
import pickletools
import warnings
from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ttscompile.core.spec import Instruction, PolicySpec
from ttscompile.core.tokenizer import StateInWords
from ttscompile.core.zip_files import open_zip
from ttscompile.errors import CheckpointError
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.refusals import LEROBOT, refuse_policy
from ttscompile.frontends.saved_weights import names_of
from ttscompile.frontends.settings import MAX_BYTES, Settings, read_json

from .lerobot import pi, vla
from .lerobot.config import ACTION, CONFIG, MOST, MOST_STEPS, STATE, WEIGHTS, LeRobotConfig
from .lerobot.policy import MASK, TOKENS, weights_in
from .lerobot.processors import Processors, Statistics
from .lerobot.tokenizer import file_of_name
from .openpi_params import read_params

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
_SIDE = 224
"""Of the images, as the network sees them."""
NOTES, PARAMS, ASSETS, NORMS = "metadata.pt", "params", "assets", "norm_stats.json"
_NOTED = frozenset("action_dim action_horizon max_token_len pi05 discrete_state_input dtype".split())
"""Entries of the model's configuration that ``NOTES`` is looked through for."""
_TRUTH = {"NEWTRUE": True, "NEWFALSE": False}
_TOLD = ("BININT", "BININT1", "BININT2", "BINUNICODE", *_TRUTH)
"""Codes of a pickle that are a value."""
_EPSILON = 1e-6
"""What openpi adds to deviations and ranges."""
_MOST_SETS, _LARGEST = 100, 1e30
_TRAINING = "the config of its training (openpi's training/config.py)"

Pairs = dict[str, tuple[Tensor, Tensor]]
"""Of state and actions means and deviations, or two quantiles, float64 ``[D]``."""


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    settings = _settings(directory)
    saved, adapted = _weights(directory, settings)
    weights = pi.named_weights(saved)
    adaptive, width = _variant(directory, weights)
    if settings.flag("pi05", adaptive) != adaptive:
        raise settings.refusal("pi05", f"{adaptive}, which the weights say".lower())
    name, pairs = _statistics(directory, "q01 q99" if adaptive else "mean std", width)
    count, actions = (len(pairs[part][0]) for part in ("state", "actions"))
    features: dict[str, tuple[str, tuple[int, ...]]] = {STATE: ("STATE", (count,)), ACTION: ("ACTION", (actions,))}
    features |= dict.fromkeys(vla.kept_cameras(directory, CAMERAS, options), ("VISUAL", (3, _SIDE, _SIDE)))
    known = {"type": "pi05" if adaptive else "pi0", "max_state_dim": width, "dtype": settings.values["dtype"]}
    known["max_action_dim"] = settings.number("action_dim", width, MOST)
    known["tokenizer_max_length"] = settings.number("max_token_len", 200 if adaptive else 48, MOST)
    horizon = settings.number("action_horizon", most=MOST_STEPS)
    shared = LeRobotConfig(directory, replace(settings, values=known), features, 1, horizon, horizon)
    told = Instruction(TOKENS, MASK, True, spaced=True)
    if adaptive and settings.flag("discrete_state_input", True):
        low, high = pairs["state"]
        first, span = tuple(low.tolist()), tuple((high - low + _EPSILON).tolist())
        told = pi.told_with(StateInWords("state", first, span, ranged=True, double=True))
    ways = {part: _normalizer(*pair, adaptive) for part, pair in pairs.items()}
    processors = Processors({STATE: ways["state"]}, ways["actions"], {STATE: "state"}, {})
    config = replace(pi.read_config(shared, weights, adaptive), rounded_words=False)
    module, spec = pi.built(shared, processors, config, weights, told, options, "bytes")
    _warn(directory, adaptive and "discrete_state_input" not in settings.values, adapted)
    return module, replace(spec, source={**spec.source, "format": "openpi", "statistics": name})


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """PaliGemma's tokenizer, if it is on this machine; see ``Family``."""
    return file_of_name(pi.TOKENIZER, directory, encoders)


def _warn(directory: Path, assumed: bool, adapted: bool) -> None:
    told = (
        f"{directory}: what openpi saves is compiled. Your robot's own transforms are code, and stay outside: give what"
        " data_transforms.inputs gives, and give the actions to data_transforms.outputs (docs/howto/vla.md, openpi)."
    )
    if assumed:
        told += (
            " Nothing here says discrete_state_input, so the state is in the prompt, as by openpi's default: if"
            f" {_TRAINING} has false, as pi05_libero's, write that into {CONFIG}, and convert again."
        )
    if adapted:
        told += " Adapters (LoRA) are merged with the scale 1, alpha = rank, that openpi's variants have."
    warnings.warn(told, stacklevel=5)


def _settings(directory: Path) -> Settings:
    """What is said of the training: by its notes, and by ``config.json``, where that says more or something else."""
    noted = _noted(directory / NOTES) if (directory / NOTES).is_file() else {}
    own = read_json(directory / CONFIG) if (directory / CONFIG).is_file() else {}
    values = {**noted, **own, "dtype": noted.get("dtype", "float32")}
    return Settings(values, f"{directory / CONFIG}: ", f"Write there what {_TRAINING} has.")


def _noted(path: Path) -> dict[str, Any]:
    """Entries of a pickled configuration. It is looked through for their names: nothing is unpickled."""
    found: dict[str, Any] = {}
    try:
        with path.open("rb") as file, open_zip(file) as archive:
            inner = next((each for each in archive.namelist() if each.endswith("data.pkl")), "data.pkl")
            with archive.open(inner) as pickled:
                data = pickled.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError(f"its pickle has more than {MAX_BYTES:,} bytes")
        name = ""
        for code, value, _ in pickletools.genops(data):
            if code.name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
                continue
            if name and code.name in _TOLD:
                found[name] = _TRUTH.get(code.name, value)
            name = value if code.name == "BINUNICODE" and value in _NOTED - set(found) else ""
    except Exception as error:  # what the two readers raise depends on where the file is damaged
        told = "not the notes of a training of openpi's, or damaged ones"
        raise CheckpointError(f"{path}: {told}: {error!s:.200}. Copy it again.") from error
    return found


def _weights(directory: Path, settings: Settings) -> tuple[dict[str, Tensor], bool]:
    """Under the names of openpi's PyTorch, and whether adapters were merged into them."""
    if not (directory / WEIGHTS).is_file() and (directory / PARAMS).is_dir():
        return read_params(directory / PARAMS)
    for key in ("paligemma_variant", "action_expert_variant"):
        if "lora" in str(settings.values.get(key)):
            raise settings.error(
                f"{key} is {settings.values[key]!r:.80}: openpi's converter leaves out what LoRA learned, so these are"
                f" the weights of its base. Give the folder that it converted, which has {PARAMS}"
            )
    return weights_in(directory, *pi.UNREAD), False


def _variant(directory: Path, weights: Mapping[str, Tensor]) -> tuple[bool, int]:
    """Whether the network is pi0.5's, and how many numbers an action has in it."""
    entry, adaptive = weights.get("action_in_proj.weight"), "time_mlp_in.weight" in weights
    if entry is None and any("language_model.layers." in name for name in weights):
        refuse_policy("pi0_fast", LEROBOT, f"{directory}: ")
    if entry is None or entry.ndim != 2 or adaptive == ("action_time_mlp_in.weight" in weights):
        told = names_of(sorted(weights)) or "none"
        raise CheckpointError(f"{directory}: expected the weights of openpi's pi0 or pi0.5; found {told}.")
    return adaptive, entry.shape[1]


def _statistics(directory: Path, names: str, width: int) -> tuple[str, Pairs]:
    """The one data set's whose statistics are there, and which that is.

    A state and actions that are as wide as the network's may have been padded before they were measured: zeros at the
    end are not the robot's.
    """
    files = sorted(islice((directory / ASSETS).rglob(NORMS), _MOST_SETS))
    known = [each.parent.relative_to(directory / ASSETS).as_posix() for each in files]
    if len(files) != 1:
        told = f"expected the statistics of one data set, {ASSETS}/NAME/{NORMS}; found {names_of(known) or 'none'}"
        remedy = f"Copy the folder without the others, and with the folder {ASSETS} of the training"
        raise CheckpointError(f"{directory}: {told}. {remedy}.")
    found: Pairs = {}
    whole = Settings(read_json(files[0]), f"{files[0]}: ", "Copy it from the training again.").part("norm_stats")
    for part in ("state", "actions"):
        own = whole.part(part)
        mean, deviation, first, second = (_vector(own, name, width) for name in ("mean", "std", *names.split()))
        if len({len(each) for each in (mean, deviation, first, second)}) > 1:
            raise own.error(f"mean, std, {names.replace(' ', ', ')} have several lengths; expected one")
        if (deviation < 0).any():
            raise own.refusal("std", "numbers that are not negative")
        if names != "mean std" and (second < first).any():
            raise own.refusal("q99", "numbers that are not below q01")
        robot = ((mean != 0) | (deviation != 0)).nonzero()
        count = int(robot.max()) + 1 if len(mean) == width and len(robot) else len(mean)
        found[part] = first[:count], second[:count]
    return known[0], found


def _vector(own: Settings, name: str, most: int) -> Tensor:
    value: Any = own.values.get(name)
    whole = isinstance(value, list) and 0 < len(value) <= most
    if whole and all(type(one) in (int, float) and abs(one) < _LARGEST for one in value):
        return torch.tensor(value, dtype=torch.float64, device="cpu")
    raise own.refusal(name, f"1 to {most} finite numbers")


def _normalizer(first: Tensor, second: Tensor, ranged: bool) -> Statistics:
    return Statistics("QUANTILES" if ranged else "MEAN_STD", first, second + _EPSILON, 0.0)
