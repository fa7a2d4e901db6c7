"""The weights of a LeRobot policy: read first, and compared with the configuration before a network is built."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

from ..errors import CheckpointError
from .clip_config import TextConfig, VisionConfig
from .lerobot_config import LeRobotConfig
from .lerobot_processors import read_tensors
from .multi_task_dit import DiffusionTransformer, ObservationEncoder
from .saved_weights import require_finite, require_names, require_shape, unwrapped

_MOST_LAYERS = 512
"""Of all transformers together. Each is made twice, first without memory, which takes time."""

Parts = Mapping[str, nn.Module]
"""By the prefix of its weights: the denoiser and the observation encoder."""


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights of a policy as float32, under the names that transformers 5 gives.

    Raises:
        CheckpointError: missing, damaged, or a tensor that is no weight.
    """
    found: dict[str, torch.Tensor] = {}
    for key, value in read_tensors(path).items():
        # transformers 4 saves an encoder below a level of its own, which transformers 5 leaves out.
        short = unwrapped(key).replace(".model.vision_model.", ".model.")
        short = short.replace(".text_encoder.text_model.", ".text_encoder.")
        if short.endswith(".position_ids"):
            continue
        if not value.is_floating_point():
            raise CheckpointError(f"{path}: weight {key} is a {value.dtype} tensor; expected floating-point numbers.")
        found[short] = value.float()
    return found


def parts_without_memory(config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig) -> Parts:
    """What a configuration describes, on the meta device: shapes, and no memory, whatever the configuration asks for.

    Raises:
        CheckpointError: more layers than any policy has.
    """
    eyes = 0 if vision is None else vision.num_hidden_layers
    if config.separate_encoders:
        eyes *= len(config.cameras)
    layers = config.network.num_layers + text.num_hidden_layers + eyes
    if layers > _MOST_LAYERS:
        raise CheckpointError(
            f"the configuration asks for {layers} layers, {eyes} of them of image encoders; expected"
            f" {_MOST_LAYERS} at most. config.json, or the encoder's, is of another network than the one that was"
            " saved."
        )
    with torch.device("meta"):
        return network_parts(config, vision, text)


def network_parts(config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig) -> Parts:
    """Denoiser and observation encoder without their weights."""
    cameras, network = len(config.cameras), config.network
    seen = 0 if vision is None else vision.hidden_size * cameras
    frame = config.state_dim + seen + network.hidden_dim
    return {
        "noise_predictor.": DiffusionTransformer(network, config.n_obs_steps * frame),
        "observation_encoder.": ObservationEncoder(
            cameras, vision, text, network.hidden_dim, config.separate_encoders, config.n_obs_steps
        ),
    }


def require_weights(parts: Parts, weights: Mapping[str, torch.Tensor]) -> None:
    """Raise unless every weight is there, of the right shape, finite, and nothing else is there.

    Args:
        parts: on any device; only their shapes are looked at.
        weights: of ``read_weights``.

    Raises:
        CheckpointError: names what does not fit.
    """
    expected = {
        prefix + name: value.shape for prefix, part in parts.items() for name, value in part.state_dict().items()
    }
    missing, extra = sorted(set(expected) - set(weights)), sorted(set(weights) - set(expected))
    require_names(
        missing,
        extra,
        "the weights do not fit the configuration",
        "config.json, or the encoder's, is of another network than the one that was saved, or the file is incomplete.",
    )
    for key, value in weights.items():
        require_shape(key, value, expected[key], "config.json and the encoder's configuration")
        require_finite(key, value)


def fill(parts: Parts, weights: Mapping[str, torch.Tensor]) -> None:
    """Load weights that fit."""
    for prefix, part in parts.items():
        part.load_state_dict(
            {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
        )
