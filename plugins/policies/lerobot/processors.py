"""LeRobot's processors: what is done to observations before the policy, and to actions after it.

Source: ``lerobot.processor`` of huggingface/lerobot 0.6.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ttscompile.core.poses import Pose
from ttscompile.core.spec import Affine
from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import read_tensors
from ttscompile.frontends.settings import Settings, read_json

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

_RENAME, _TOKENIZE, NORMALIZE = "rename_observations_processor", "tokenizer_processor", "normalizer_processor"
_UNNORMALIZE, _BATCH, _DEVICE = "unnormalizer_processor", "to_batch_processor", "device_processor"
_NEW_LINE = ("smolvla_new_line_processor", "pi0_new_line_processor")
PROMPT = "pi05_prepare_state_tokenizer_processor_step"
_RELATIVE, _ABSOLUTE = "relative_actions_processor", "absolute_actions_processor"
_PAD = ("evo1_pad_state_processor", "evo1_pad_action_processor")
_CROP = "evo1_action_processor"
"""What it does is in the policy's configuration, which lerobot prefers to the step's own."""
_COMMON = {PREPROCESSOR: (_RENAME, _BATCH, _DEVICE, _RELATIVE), POSTPROCESSOR: (_BATCH, _DEVICE, _ABSOLUTE)}
"""Steps that all policies have, or may have."""
_BEFORE, _AFTER = (_TOKENIZE, NORMALIZE, *_NEW_LINE, *_PAD, PROMPT), (_UNNORMALIZE, _CROP)
"""Beside them, those before and after a policy."""
IMAGENET, DOMAIN = "xvla_imagenet_normalize", "xvla_add_domain_id"
GROOT = ("groot_n1_7_pack_inputs_v1", "groot_action_unpack_unnormalize_v2", "groot_n1_7_action_decode_v1")
PREPARE, CLIP = "vla_jepa_image_prep", "vla_jepa_clip_actions"
SNAP, BINARIZE = "vla_jepa_pre_snap_gripper", "vla_jepa_binarize_gripper"
CONVERSATION, READ = "eo1_conversation_template_processor", "eo1_qwen_processor"
SENTENCE = "wall_x_task_processor"
OWN_STEPS: Mapping[str, tuple[str, ...]] = {
    "xvla": ("xvla_image_to_float", IMAGENET, DOMAIN),
    "vla_jepa": (PREPARE,),
    "eo1": (CONVERSATION, READ),
    "wall_x": (SENTENCE,),
}
"""By type of policy, steps before it that no other has, in the order that lerobot saves."""
_OWN_LATER: Mapping[str, tuple[str, ...]] = {"vla_jepa": (CLIP, SNAP, _UNNORMALIZE, BINARIZE)}
"""By type of policy, steps after it of which no other has all, in the only order that is known."""
_CHANGES = frozenset({NORMALIZE, _UNNORMALIZE, *_PAD, *GROOT})
"""Steps that change the state, or make actions of what the network gives."""
_OFTEN = frozenset({_BATCH, _DEVICE})
"""Steps that may be anywhere, more than once."""


Features = Mapping[str, tuple[str, tuple[int, ...]]]
"""Type (``STATE``, ``VISUAL``, ``ACTION``) and shape by the policy's name, as its configuration has them."""

STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""The two statistics of each mode."""

_NEUTRAL = {"mean": 0.0, "std": 1.0, **dict.fromkeys(("min", "q01", "q10"), -1.0)}
"""What evo1 pads statistics with; 1 for the others."""

STATE = "observation.state"

_PADS_STATE = ("eo1", "pi0", "pi05", "smolvla", "wall_x", "xvla")
"""Types whose network takes states of several widths. A policy that was fine-tuned from a base keeps the base's width
in its configuration, and only the statistics say how many numbers the state of its robot has."""

_LEAST_STD = 1e-30
"""Stands for a standard deviation of zero, which gives the mean whatever the network says."""


@dataclass(frozen=True)
class Statistics:
    """How one feature is normalised: its mode, and the two statistics that the mode names, float32; openpi's float64.

    Attributes:
        mode: ``MEAN_STD``, ``MIN_MAX``, ``QUANTILES`` or ``QUANTILE10``.
        first: mean, or the lower end of the range.
        second: standard deviation, or the upper end.
        still: whether a number that has no range is 0.
        clipped: whether what is out of range is clipped.
    """

    mode: str
    first: torch.Tensor
    second: torch.Tensor
    eps: float
    still: bool = False
    clipped: bool = False

    @property
    def width(self) -> torch.Tensor:
        """What is divided by: ``std + eps``; or the range, and ``eps`` where that is zero."""
        if self.mode == "MEAN_STD":
            return self.second + self.eps
        width = self.second - self.first
        return torch.where(width == 0, torch.tensor(self.eps, dtype=width.dtype), width)

    @property
    def usual_range(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Of a vector: where its values usually are, by these statistics; of MEAN_STD two deviations to each side."""
        low, high = self.first, self.second
        if self.mode == "MEAN_STD":
            low, high = self.first - 2 * self.second, self.first + 2 * self.second
        low, high = torch.minimum(low, high), torch.maximum(low, high)
        return tuple(low.tolist()), tuple(high.tolist())

    def unnormalized(self, x: torch.Tensor, channel: int) -> torch.Tensor:
        """Numbers of one channel of a vector in their own units, as lerobot computes them."""
        if self.mode == "MEAN_STD":
            return x * self.second[channel] + self.first[channel]
        return (x + 1) / 2 * self.width[channel] + self.first[channel]

    def inverse(self, steps: int = 1) -> Affine:
        """The inverse as an ``Affine``, for vectors; of a chunk's steps, where statistics have rows, the last repeated.

        MEAN_STD inverts with the bare standard deviation.
        """
        first, moved = self.first.double().numpy(), 0 if self.mode == "MEAN_STD" else 1
        scale = 2 / self.width.double().numpy()
        if self.mode == "MEAN_STD":
            scale = 1 / np.maximum(self.second.double().numpy(), _LEAST_STD)
        own = Affine(scale=scale.astype(np.float32), offset=(-first * scale - moved).astype(np.float32))
        return own.at(np.minimum(np.arange(steps), len(scale) - 1))


class Normalizer(nn.Module):
    """``(x - mean) / (std + eps)``, or ``2 (x - low) / range - 1``, as LeRobot writes it.

    It is part of the compiled network rather than an ``Affine`` of the observation: images are normalised by channel,
    and a channel that never changed in training is divided by 1e-8, which only this order of operations survives.

    Args:
        statistics: of a feature, broadcast against its values; None leaves them as they are.
    """

    first: torch.Tensor
    width: torch.Tensor
    still: torch.Tensor | None

    def __init__(self, statistics: Statistics | None) -> None:
        super().__init__()
        self.mode = None if statistics is None else statistics.mode
        self.clipped = statistics is not None and statistics.clipped
        if statistics is not None:
            self.register_buffer("first", statistics.first, persistent=False)
            self.register_buffer("width", statistics.width, persistent=False)
            still = statistics.second == statistics.first if statistics.still else None
            self.register_buffer("still", still, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, To, ...]`` -> the same."""
        if self.mode is None:
            return x
        if self.mode == "MEAN_STD":
            return (x - self.first) / self.width
        scaled = 2 * (x - self.first) / self.width - 1
        scaled = scaled if self.still is None else torch.where(self.still, 0.0, scaled)
        return scaled.clamp(-1, 1) if self.clipped else scaled


@dataclass(frozen=True)
class Processors:
    """What the two pipelines of a policy do.

    Attributes:
        normalizers: statistics by the policy's name of each feature; of those that pass as they are there are none.
        action: of the action; None where it passes as it is.
        renamed: the policy's name of an observation -> the name that the robot gives it, where they differ.
        tokenizer: settings of the tokenizer; none without one.
        new_line: whether an instruction ends with a new line before it is tokenized.
        state_in_prompt: whether it holds the state too, as numbers in words.
        own: settings of the steps around the policy that its type alone has, by name, in their order.
        relative: for each number of an action, which number of the state it is relative to; None for none. Empty where
            actions are absolute.
        poses: of an action, that are relative to poses of the state.
        state_dim: numbers of the state in the data, where the configuration may have those of a base.
    """

    normalizers: Mapping[str, Statistics]
    action: Statistics | None
    renamed: Mapping[str, str]
    tokenizer: Mapping[str, Any]
    new_line: bool = False
    state_in_prompt: bool = False
    own: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    relative: tuple[int | None, ...] = ()
    poses: tuple[Pose, ...] = ()
    state_dim: int | None = None


def read_processors(directory: Path, features: Features, kind: str = "") -> Processors:
    """The pipelines of a policy of this type that LeRobot saved, with these features."""
    own, later = OWN_STEPS.get(kind, ()), _OWN_LATER.get(kind, ())
    before = read_steps(directory, PREPROCESSOR, (*_BEFORE, *own))
    after = read_steps(directory, POSTPROCESSOR, (*_AFTER, *later))
    order = [step["registry_name"] for step in after if step["registry_name"] in later]
    if order != [name for name in later if name in order]:
        raise CheckpointError(f"{directory / POSTPROCESSOR}: found {', '.join(order)}; expected {', '.join(later)}.")
    padded = any(step["registry_name"] in _PAD for step in before)
    width: int | None = None
    if kind in _PADS_STATE and STATE in features:
        width = _state_width(directory, before) or features[STATE][1][0]
        features = {**features, STATE: ("STATE", (width,))}
    return Processors(
        renamed=renamed_observations(directory, before, features),
        normalizers=_statistics(directory, before, NORMALIZE, features, padded),
        action=_statistics(directory, after, _UNNORMALIZE, features, padded).get("action"),
        tokenizer=next((dict(step["config"]) for step in before if step["registry_name"] == _TOKENIZE), {}),
        new_line=any(step["registry_name"] in _NEW_LINE for step in before),
        state_in_prompt=any(step["registry_name"] == PROMPT for step in before),
        own={
            step["registry_name"]: step["config"]
            for step in (*before, *after)
            if step["registry_name"] in (*own, *later)
        },
        relative=relative_entries(directory, before, after, features),
        state_dim=width,
    )


def _state_width(directory: Path, steps: list[dict[str, Any]]) -> int | None:
    """Numbers of the state in the data, by its statistics, which are saved whether or not it is normalised."""
    step = next((step for step in steps if step["registry_name"] == NORMALIZE), None)
    tensors = {} if step is None else state_of(directory, step)
    found = (tensors.get(f"{STATE}.{name}") for name, _ in STATISTICS.values())
    return next((len(value) for value in found if value is not None and value.ndim == 1), None)


def relative_entries(
    directory: Path, before: list[dict[str, Any]], after: list[dict[str, Any]], features: Features
) -> tuple[int | None, ...]:
    """What the pair of steps makes of actions: see ``Processors.relative``."""
    orders = [[step["registry_name"] for step in steps] for steps in (before, after)]
    both = [step for step in (*before, *after) if step["registry_name"] in (_RELATIVE, _ABSOLUTE)]
    own = [Settings(step["config"], f"{directory}: {step['registry_name']}.") for step in both]
    enabled = [each.flag("enabled", False) for each in own]
    if not any(enabled):
        return ()
    (count,), state = features["action"][1], features.get(STATE, ("", (0,)))[1][0]
    names, excluded = own[0].values.get("action_names"), own[0].values.get("exclude_joints") or []
    if enabled != [True, True] or any(name in _CHANGES for name in orders[0][: orders[0].index(_RELATIVE)]):
        told = f"expected {_RELATIVE} before the state is changed, and {_ABSOLUTE}, both enabled or none"
        raise CheckpointError(f"{directory}: {told}; found {orders[0]} and {orders[1]}, enabled: {enabled}.")
    if orders[1].index(_ABSOLUTE) < max(i for i, name in enumerate(orders[1]) if name in _CHANGES):
        raise CheckpointError(f"{directory}: expected {_ABSOLUTE} after actions are unnormalised; found {orders[1]}.")
    if state < count and state != 1:  # lerobot adds one number to all
        told = f"{_RELATIVE}: the {count} numbers of an action are relative to a state, which has {state}"
        raise CheckpointError(f"{directory}: {told}; expected as many.")
    for entry in (names or [], excluded):
        if not isinstance(entry, list) or not all(isinstance(name, str) for name in entry):
            raise own[0].error(f"found {own[0].values!s:.300}; expected names in action_names and exclude_joints")
    absolute = [any(part and part.lower() in name.lower() for part in excluded) for name in (names or [])[:count]]
    return tuple(None if i < len(absolute) and absolute[i] else min(i, state - 1) for i in range(count))


def read_steps(directory: Path, name: str, own: Collection[str]) -> list[dict[str, Any]]:
    """The steps of a pipeline, each with a registered name that is known and a configuration, in lerobot's order.

    Args:
        own: names that are known beside the common ones.
    """
    path, known = directory / name, (*_COMMON[name], *own)
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file. Policies saved by lerobot before 0.4 keep their statistics inside the weights:"
            " migrate it with lerobot's own script (lerobot.processor.migrate_policy_normalization), and convert that."
        )
    steps = read_json(path).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise CheckpointError(f"{path}: has no list of steps; expected a pipeline that lerobot saved.")
    for step in steps:
        registered = step.get("registry_name")  # a step of somebody's own has a class instead
        if not isinstance(registered, str) or registered not in known:
            raise CheckpointError(
                f"{path}: the step {step.get('registry_name', step.get('class'))!r:.80} is not known here; expected"
                f" {', '.join(sorted(known))}. Do its work outside of the policy, and leave it out."
            )
        if not isinstance(step.setdefault("config", {}), dict):
            raise CheckpointError(f"{path}: the configuration of {registered} is no object.")
        if registered == _DEVICE and step["config"].get("float_dtype") not in (None, "float32"):
            found = f"{registered}.float_dtype is {step['config']['float_dtype']!r:.80}"
            raise CheckpointError(f"{path}: {found}; expected null or float32, in which the compiled policy computes.")
    order = [step["registry_name"] for step in steps]
    twice = sorted(kind for kind in known if kind not in _OFTEN and order.count(kind) > 1)
    if twice:
        found = f"found {order.count(twice[0])} of {twice[0]}"
        raise CheckpointError(f"{path}: expected at most one step of a kind; {found}. Combine them into one.")
    if _RENAME in order and not _OFTEN.issuperset(order[: order.index(_RENAME)]):
        raise CheckpointError(
            f"{path}: expected {_RENAME} before the other steps, as lerobot saves them; found {', '.join(order)}."
            " Save the pipeline again in that order."
        )
    return steps


def renamed_observations(directory: Path, steps: list[dict[str, Any]], features: Features) -> dict[str, str]:
    """The policy's name of each renamed observation -> the robot's."""
    step = next((step for step in steps if step["registry_name"] == _RENAME), None)
    names = {} if step is None else Settings(step["config"], f"{directory}: {_RENAME}.").names("rename_map")
    renamed = {new: old for old, new in names.items()}
    given = [renamed.get(key, key) for key, (kind, _) in features.items() if kind != "ACTION"]
    if len(renamed) < len(names) or len(set(given)) < len(given):
        raise CheckpointError(
            f"{directory}: {_RENAME}.rename_map is {names!s:.300}; expected one name of the robot for each"
            " observation of the policy, and the other way round."
        )
    return renamed


def state_of(directory: Path, step: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """The tensors that a step saved; none where it has no file."""
    file = step.get("state_file")
    if file is not None and (not isinstance(file, str) or Path(file).name != file or len(file) > 200):
        raise CheckpointError(f"{directory}: state_file {file!r:.80} is not the name of a file in this directory.")
    return {} if file is None else read_tensors(directory / file)


def _statistics(
    directory: Path, steps: list[dict[str, Any]], registered: str, features: Features, padded: bool
) -> dict[str, Statistics]:
    """Statistics of each feature that a normalising step changes; without any lerobot changes nothing.

    Args:
        padded: whether vectors may be padded, by zeros that stay zeros.
    """
    step = next((step for step in steps if step["registry_name"] == registered), None)
    if step is None:
        raise CheckpointError(f"{directory}: expected one step {registered}; found none.")
    settings = Settings(step["config"], f"{directory}: {registered}.")
    modes, eps = settings.names("norm_map"), settings.values.get("eps", 1e-8)
    if not isinstance(eps, float) or not eps > 0:
        raise settings.refusal("eps", "a positive number")
    tensors = state_of(directory, step)
    only, own = settings.values.get("normalize_observation_keys"), settings.values.get("features", {})
    if not isinstance(own, dict):
        raise settings.refusal("features", "type and shape by name")
    if only is not None and not (isinstance(only, list) and all(isinstance(key, str) for key in only)):
        raise settings.refusal("normalize_observation_keys", "a list of names, or null")
    result = {}
    for key, (kind, shape) in features.items():
        mode = modes.get(kind, "IDENTITY")
        # lerobot looks for observations in ``features``, and never for the action.
        skipped = kind != "ACTION" and (key not in own or (only is not None and key not in only))
        if mode == "IDENTITY" or skipped:
            continue
        if mode not in STATISTICS:
            raise settings.refusal("norm_map", f"one of IDENTITY, {', '.join(STATISTICS)} for {kind}")
        names = [f"{key}.{name}" for name in STATISTICS[mode]]
        if not any(name.rpartition(".")[0] == key for name in tensors):
            continue
        missing = [name for name in names if name not in tensors]
        if missing:
            raise CheckpointError(f"{directory}: {registered} needs {', '.join(missing)} for {mode}; there is none.")
        own_numbers = {name: _unpadded(name, tensors[name], shape) if padded else tensors[name] for name in names}
        first, second = (as_statistic(directory, name, value, kind, shape) for name, value in own_numbers.items())
        if mode == "MEAN_STD" and (second < 0).any():
            raise CheckpointError(f"{directory}: {names[1]} has a deviation below 0. Compute the statistics again.")
        result[key] = Statistics(mode, first, second, eps)
    return result


def _unpadded(name: str, value: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """The statistic of the vector's own numbers, where the others are what evo1 pads with."""
    neutral = _NEUTRAL.get(name.rpartition(".")[2], 1.0)
    own = value[: shape[0]] if value.ndim == len(shape) == 1 else value
    return own if bool((value[len(own) :] == neutral).all()) else value


def as_statistic(directory: Path, name: str, value: torch.Tensor, kind: str, shape: tuple[int, ...]) -> torch.Tensor:
    """A statistic in the shape that broadcasts: one entry a channel; of an image ``[channels, 1, 1]``."""
    value = value.to(torch.float32)
    if kind == "VISUAL" and value.ndim == 1:
        value = value.reshape(-1, 1, 1)
    expected = (shape[0], 1, 1) if kind == "VISUAL" else shape
    if tuple(value.shape) != expected:
        raise CheckpointError(f"{directory}: {name} has shape {tuple(value.shape)}; expected {expected}.")
    if not torch.isfinite(value).all():
        raise CheckpointError(f"{directory}: {name} holds values that are not finite. Compute the statistics again.")
    return value
