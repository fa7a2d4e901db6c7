"""LeRobot's processors: what is done to observations before the policy, and to actions after it.

Source: ``lerobot.processor`` of huggingface/lerobot 0.6, of which only the arithmetic of its normalisers matters here.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from ..config import Affine
from ..errors import CheckpointError
from .clip_config import read_json

ACTION = "action"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

_STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
_KNOWN_STEPS = frozenset(
    {
        "rename_observations_processor",
        "to_batch_processor",
        "tokenizer_processor",
        "device_processor",
        "normalizer_processor",
        "unnormalizer_processor",
    }
)
_LEAST_STD = 1e-30
"""Stands for a standard deviation of zero, which gives the mean whatever the network says."""


@dataclass(frozen=True)
class Statistics:
    """How one feature is normalised: its mode, and the two statistics that the mode names, float32.

    Attributes:
        mode: ``MEAN_STD``, ``MIN_MAX``, ``QUANTILES`` or ``QUANTILE10``.
        first: mean, or the lower end of the range.
        second: standard deviation, or the upper end.
        eps: of the processor's configuration.
    """

    mode: str
    first: torch.Tensor
    second: torch.Tensor
    eps: float

    @property
    def width(self) -> torch.Tensor:
        """What is divided by: ``std + eps``; or the range, and ``eps`` where that is zero."""
        if self.mode == "MEAN_STD":
            return self.second + self.eps
        width = self.second - self.first
        return torch.where(width == 0, torch.tensor(self.eps, dtype=width.dtype), width)

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Of a vector: the range that the statistics speak of; of MEAN_STD two deviations to each side."""
        low, high = self.first, self.second
        if self.mode == "MEAN_STD":
            low, high = self.first - 2 * self.second, self.first + 2 * self.second
        low, high = torch.minimum(low, high), torch.maximum(low, high)
        return tuple(low.tolist()), tuple(high.tolist())

    def inverse(self) -> Affine:
        """The inverse as an ``Affine``, for vectors. MEAN_STD inverts with the bare standard deviation."""
        first = self.first.double().numpy()
        if self.mode == "MEAN_STD":
            scale = 1 / np.maximum(self.second.double().numpy(), _LEAST_STD)
            return Affine(scale=scale.astype(np.float32), offset=(-first * scale).astype(np.float32))
        scale = 2 / self.width.double().numpy()
        return Affine(scale=scale.astype(np.float32), offset=(-first * scale - 1).astype(np.float32))


class Normalizer(nn.Module):
    """``(x - mean) / (std + eps)``, or ``2 (x - low) / range - 1``, as LeRobot writes it.

    It is part of the compiled network rather than an ``Affine`` of the observation: images are normalised by channel,
    and a channel that never changed in training is divided by 1e-8, which only this order of operations survives.

    Args:
        statistics: of a feature, broadcast against its values; None leaves them as they are.
    """

    first: torch.Tensor
    width: torch.Tensor

    def __init__(self, statistics: Statistics | None) -> None:
        super().__init__()
        self.mode = None if statistics is None else statistics.mode
        if statistics is not None:
            self.register_buffer("first", statistics.first, persistent=False)
            self.register_buffer("width", statistics.width, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, To, ...]`` -> the same."""
        if self.mode is None:
            return x
        if self.mode == "MEAN_STD":
            return (x - self.first) / self.width
        return 2 * (x - self.first) / self.width - 1


@dataclass(frozen=True)
class Processors:
    """What the two pipelines of a policy do.

    Attributes:
        normalizers: statistics by the policy's name of each feature; those that pass as they are, are absent.
        action: of the action; None where it passes as it is.
        renamed: the policy's name of an observation -> the name that the robot gives it, where they differ.
        tokenizer: settings of the tokenizer; None without one.
    """

    normalizers: Mapping[str, Statistics]
    action: Statistics | None
    renamed: Mapping[str, str]
    tokenizer: Mapping[str, Any] | None


def read_processors(directory: Path, features: Mapping[str, tuple[str, tuple[int, ...]]]) -> Processors:
    """The pipelines of a directory that LeRobot saved.

    Args:
        directory: of the policy.
        features: of the policy: type (``STATE``, ``VISUAL``, ``ACTION``) and shape by name.

    Raises:
        CheckpointError: a file is missing or damaged, or there is a step that is not known.
    """
    before, after = (_steps(directory, name) for name in (PREPROCESSOR, POSTPROCESSOR))
    renamed: dict[str, str] = {}
    for step in before:
        if step["registry_name"] == "rename_observations_processor":
            renamed = {new: old for old, new in _mapping(step, directory, "rename_map").items()}
    statistics = _statistics(directory, before, "normalizer_processor", features)
    inverse = _statistics(directory, after, "unnormalizer_processor", features)
    tokenizers = [dict(step["config"]) for step in before if step["registry_name"] == "tokenizer_processor"]
    return Processors(
        normalizers={key: value for key, value in statistics.items() if features[key][0] != "ACTION"},
        action=inverse.get(ACTION),
        renamed=renamed,
        tokenizer=tokenizers[0] if tokenizers else None,
    )


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a safetensors file on the CPU; the format holds nothing that could run.

    Raises:
        CheckpointError: missing or damaged.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file. Copy the policy's directory whole.")
    try:
        tensors: dict[str, torch.Tensor] = load_file(path, device="cpu")
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path}: not a safetensors file, or a truncated one: {error}. Copy it again.") from error
    return tensors


def _steps(directory: Path, name: str) -> list[dict[str, Any]]:
    """The steps of a pipeline, each with a registered name that is known and a configuration."""
    path = directory / name
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file. Policies saved by lerobot before 0.4 keep their statistics inside the weights;"
            " migrate it with lerobot's own script (lerobot.processor.migrate_policy_normalization), and convert what"
            " that writes."
        )
    steps = read_json(path).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise CheckpointError(f"{path}: has no list of steps; expected a pipeline that lerobot saved.")
    for step in steps:
        registered = step.get("registry_name", step.get("class"))
        if registered not in _KNOWN_STEPS:
            raise CheckpointError(
                f"{path}: the step {registered!r} is not known, and without it actions would be wrong. Expected"
                f" {', '.join(sorted(_KNOWN_STEPS))}. Do its work outside of the policy, and leave it out of the file."
            )
        if not isinstance(step.setdefault("config", {}), dict):
            raise CheckpointError(f"{path}: the configuration of {registered} is no object.")
    return steps


def _mapping(step: Mapping[str, Any], directory: Path, key: str) -> dict[str, str]:
    value = step["config"].get(key, {})
    if not isinstance(value, dict) or not all(isinstance(item, str) for item in value.values()):
        raise CheckpointError(f"{directory}: {step['registry_name']}.{key} is {value!r}; expected names by name.")
    return value


def _statistics(
    directory: Path,
    steps: list[dict[str, Any]],
    registered: str,
    features: Mapping[str, tuple[str, tuple[int, ...]]],
) -> dict[str, Statistics]:
    """Statistics of each feature that a normalising step changes."""
    found = [step for step in steps if step["registry_name"] == registered]
    if len(found) != 1:
        raise CheckpointError(f"{directory}: expected one step {registered}; found {len(found)}.")
    (step,) = found
    config, modes = step["config"], _mapping(step, directory, "norm_map")
    eps = config.get("eps", 1e-8)
    if not isinstance(eps, float) or not eps > 0:
        raise CheckpointError(f"{directory}: {registered}.eps is {eps!r}; expected a positive number.")
    tensors = _state(directory, step)
    only, own = config.get("normalize_observation_keys"), config.get("features", {})
    result = {}
    for key, (kind, shape) in features.items():
        mode = modes.get(kind, "IDENTITY")
        skipped = only is not None and kind != "ACTION" and key not in only
        if mode == "IDENTITY" or skipped or key not in own:
            continue
        if mode not in _STATISTICS:
            known = ", ".join(("IDENTITY", *_STATISTICS))
            raise CheckpointError(f"{directory}: {registered} normalises {kind} by {mode!r}; expected one of {known}.")
        names = [f"{key}.{name}" for name in _STATISTICS[mode]]
        if not any(name.rpartition(".")[0] == key for name in tensors):
            warnings.warn(
                f"{directory}: {registered} has no statistics of {key}, so it is not normalised ({mode} is configured);"
                " lerobot does the same.",
                stacklevel=5,
            )
            continue
        missing = [name for name in names if name not in tensors]
        if missing:
            raise CheckpointError(
                f"{directory}: {registered} needs {', '.join(missing)} for {mode}; its file has none."
            )
        first, second = (_broadcast(directory, name, tensors[name], kind, shape) for name in names)
        result[key] = Statistics(mode, first, second, eps)
    return result


def _state(directory: Path, step: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    name = step.get("state_file")
    if name is None:
        return {}
    if not isinstance(name, str) or Path(name).name != name:
        raise CheckpointError(f"{directory}: state_file {name!r} is not the name of a file in this directory.")
    return read_tensors(directory / name)


def _broadcast(directory: Path, name: str, value: torch.Tensor, kind: str, shape: tuple[int, ...]) -> torch.Tensor:
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
