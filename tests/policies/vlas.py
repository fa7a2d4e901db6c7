"""What tests of vision-language-action models and the makers of their golden files share."""

import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors.torch import save_file

from ttscompile.core.spec import PolicySpec
from ttscompile.core.values import fitted

from .lerobot_tiny import write_json

STATE = "observation.state"
TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
CAMERAS = ("observation.images.front", "observation.images.wrist")
SHAPES = "shapes.json"
"""In a folder that lerobot saved, of the weights, which are not kept."""

Array = npt.NDArray[Any]


def unpack(saved: Path, folder: Path, weights: Callable[[dict[str, list[int]]], dict[str, torch.Tensor]]) -> Path:
    """Lay out a policy that lerobot saved and the files beside it, with weights of the shapes that it had.

    Returns:
        The policy's directory.
    """
    shutil.copytree(saved, folder, dirs_exist_ok=True)
    shapes = folder / "policy" / SHAPES
    save_file(weights(json.loads(shapes.read_text())), folder / "policy" / "model.safetensors")
    shapes.unlink()
    return folder / "policy"


def see(directory: Path, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Give the cameras of a policy images of other sizes: height and width of each."""
    config = json.loads((directory / "config.json").read_text())
    for key, size in sizes.items():
        config["input_features"][key]["shape"] = [3, *size]
    write_json(directory / "config.json", config)


def drawn_frame(seed: int, state: int, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Array]:
    """A frame of a random state of so many numbers and, in 0..1, random images of these sizes."""
    rng = np.random.RandomState(seed)
    found: dict[str, Array] = {STATE: rng.standard_normal(state).astype(np.float32)}
    return found | {key: rng.uniform(0, 1, (3, *size)).astype(np.float32) for key, size in sizes.items()}


def arrays(golden: Mapping[str, Array], call: int) -> dict[str, Array]:
    """What one call of ``smolvla.npz`` was given: raw frame, task, tokens, mask and noise."""
    names = ("task", "tokens", "attention_mask", "noise")
    frames = {key: golden[f"call{call}.frame0.{key}"] for key in (STATE, *CAMERAS)}
    return frames | {name: golden[f"call{call}.{name}"] for name in names}


def with_fewer_layers(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """SmolVLA's, of whose expert every other layer is left: those that cross."""
    found = dict[str, torch.Tensor]()
    for name, value in weights.items():
        layer = re.search(r"(\.lm_expert\.layers\.)(\d+)\.", name)
        if layer is None:
            found[name] = value
        elif int(layer[2]) % 2:
            found[name.replace(layer[0], f"{layer[1]}{int(layer[2]) // 2}.")] = value
    return found


def frame(given: Mapping[str, Array], size: tuple[int, int]) -> dict[str, Array]:
    """The frame with images of this size; other ones unless it is theirs."""
    found = {STATE: given[STATE]}
    for seed, key in enumerate(CAMERAS):
        own = given[key].shape[1:] == size
        other = np.random.RandomState(seed).uniform(0, 1, (3, *size)).astype(np.float32)
        found[key] = given[key] if own else other
    return found


def as_given(key: str, batch: Mapping[str, Array], spec: PolicySpec) -> Array:
    """One observation of a batch as the network is given it."""
    own = spec.observations[key]
    return fitted(batch[key] if own.frames is None else batch[key][:, None], own)


def pipelines(directory: str | Path) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """lerobot's steps before a policy, and those after it."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

    before = PolicyProcessorPipeline.from_pretrained(directory, config_filename="policy_preprocessor.json")
    after = PolicyProcessorPipeline.from_pretrained(
        directory,
        config_filename="policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return before, after


def processed(directory: str, raw: Mapping[str, Any], task: str) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    """The batch that lerobot's policy is given of a raw frame, and what undoes its normaliser."""
    before, after = pipelines(directory)
    batch = before({**raw, "task": task})
    return {key: value for key, value in batch.items() if key.startswith("observation.")}, after
