"""LeRobot's processors: what is done to observations before the policy, and to actions after it.

Source: ``lerobot.processor`` of huggingface/lerobot 0.6; the arithmetic is in ``lerobot_statistics``.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..errors import CheckpointError
from .lerobot_statistics import STATISTICS, Features, Statistics
from .saved_weights import read_tensors
from .settings import Settings, read_json

ACTION = "action"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

_RENAME, _TOKENIZE, _NORMALIZE = "rename_observations_processor", "tokenizer_processor", "normalizer_processor"
_UNNORMALIZE, _BATCH, _DEVICE = "unnormalizer_processor", "to_batch_processor", "device_processor"
_KNOWN_STEPS: Mapping[str, frozenset[str]] = {
    PREPROCESSOR: frozenset({_RENAME, _BATCH, _TOKENIZE, _DEVICE, _NORMALIZE}),
    POSTPROCESSOR: frozenset({_BATCH, _DEVICE, _UNNORMALIZE}),
}
_ONCE = frozenset({_RENAME, _TOKENIZE, _NORMALIZE, _UNNORMALIZE})


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


def read_processors(directory: Path, features: Features) -> Processors:
    """The pipelines of a directory that LeRobot saved.

    Args:
        directory: of the policy.
        features: of the policy.

    Raises:
        CheckpointError: a file is missing or damaged; a step is not known, there twice, or out of order.
    """
    before, after = (_steps(directory, name) for name in (PREPROCESSOR, POSTPROCESSOR))
    renamed = _renamed(directory, before, features)
    statistics = _statistics(directory, before, _NORMALIZE, features)
    inverse = _statistics(directory, after, _UNNORMALIZE, features)
    tokenizers = [dict(step["config"]) for step in before if step["registry_name"] == _TOKENIZE]
    return Processors(
        normalizers={key: value for key, value in statistics.items() if features[key][0] != "ACTION"},
        action=inverse.get(ACTION),
        renamed=renamed,
        tokenizer=tokenizers[0] if tokenizers else None,
    )


def _steps(directory: Path, name: str) -> list[dict[str, Any]]:
    """The steps of a pipeline, each with a registered name that is known and a configuration, in lerobot's order."""
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
        registered = step.get("registry_name")  # a step of somebody's own has a class instead
        if not isinstance(registered, str) or registered not in _KNOWN_STEPS[name]:
            raise CheckpointError(
                f"{path}: the step {step.get('registry_name', step.get('class'))!r:.80} is not known here, and without"
                f" it actions would be wrong. Expected {', '.join(sorted(_KNOWN_STEPS[name]))}. Do its work outside of"
                " the policy, and leave it out of the file."
            )
        if not isinstance(step.setdefault("config", {}), dict):
            raise CheckpointError(f"{path}: the configuration of {registered} is no object.")
        if registered == _DEVICE and step["config"].get("float_dtype") not in (None, "float32"):
            raise CheckpointError(
                f"{path}: {registered}.float_dtype is {step['config']['float_dtype']!r:.80}; expected null or float32:"
                " the compiled policy computes in float32. Set it to null if the policy was trained so."
            )
    order = [step["registry_name"] for step in steps]
    twice = sorted(kind for kind in _ONCE if order.count(kind) > 1)
    if twice:
        raise CheckpointError(
            f"{path}: expected at most one step of a kind; found {order.count(twice[0])} of {twice[0]}. Combine them"
            " into one, and save the pipeline again."
        )
    if _RENAME in order and any(kind in order[: order.index(_RENAME)] for kind in (_NORMALIZE, _TOKENIZE)):
        raise CheckpointError(
            f"{path}: expected {_RENAME} before the other steps, as lerobot saves them; found {', '.join(order)}. Steps"
            " before it would see other names. Save the pipeline again in that order."
        )
    return steps


def _renamed(directory: Path, steps: list[dict[str, Any]], features: Features) -> dict[str, str]:
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


def _statistics(
    directory: Path, steps: list[dict[str, Any]], registered: str, features: Features
) -> dict[str, Statistics]:
    """Statistics of each feature that a normalising step changes."""
    found = [step for step in steps if step["registry_name"] == registered]
    if len(found) != 1:
        raise CheckpointError(f"{directory}: expected one step {registered}; found {len(found)}.")
    (step,) = found
    settings = Settings(step["config"], f"{directory}: {registered}.")
    modes, eps = settings.names("norm_map"), settings.values.get("eps", 1e-8)
    if not isinstance(eps, float) or not eps > 0:
        raise settings.refusal("eps", "a positive number")
    tensors = _state(directory, step)
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
            warnings.warn(
                f"{directory}: {registered} has no statistics of {key}, so it is not normalised ({mode} is configured);"
                " lerobot does the same.",
                stacklevel=6,
            )
            continue
        missing = [name for name in names if name not in tensors]
        if missing:
            raise CheckpointError(f"{directory}: {registered} needs {', '.join(missing)} for {mode}; there is none.")
        first, second = (_broadcast(directory, name, tensors[name], kind, shape) for name in names)
        result[key] = Statistics(mode, first, second, eps)
    return result


def _state(directory: Path, step: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    name = step.get("state_file")
    if name is None:
        return {}
    if not isinstance(name, str) or Path(name).name != name or len(name) > 200:
        raise CheckpointError(f"{directory}: state_file {name!r:.80} is not the name of a file in this directory.")
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
