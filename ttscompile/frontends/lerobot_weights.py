"""The weights of a LeRobot policy: read first, and compared with the configuration before a network is built."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

from ..errors import CheckpointError
from .clip_config import TextConfig, VisionConfig
from .lerobot_config import LeRobotConfig
from .multi_task_dit import DiffusionTransformer, ObservationEncoder
from .saved_weights import as_float32, read_tensors, require_weights

_MOST_LAYERS = 512
"""Of all transformers together. Each is made twice, first without memory, which takes time."""


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights of a policy as float32, under the names that transformers 5 gives.

    Raises:
        CheckpointError: missing, damaged, or a tensor that is no weight.
    """
    saved = {name: value for name, value in read_tensors(path).items() if not name.endswith(".position_ids")}
    found = {}
    for name, value in as_float32(saved, f"{path}: ").items():
        # transformers 4 saves an encoder below a level of its own, which transformers 5 leaves out.
        short = name.replace(".model.vision_model.", ".model.")
        found[short.replace(".text_encoder.text_model.", ".text_encoder.")] = value
    return found


class Network(nn.Module):
    """Denoiser and observation encoder, under the names of their weights; made without them.

    Args:
        config: of the policy.
        vision: of its image encoders; None without cameras.
        text: of its text encoder.
    """

    def __init__(self, config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig) -> None:
        super().__init__()
        cameras, width = len(config.cameras), config.network.hidden_dim
        seen = 0 if vision is None else vision.hidden_size * cameras
        frame = config.state_dim + seen + width
        self.noise_predictor = DiffusionTransformer(config.network, config.n_obs_steps * frame)
        self.observation_encoder = ObservationEncoder(
            cameras, vision, text, width, config.separate_encoders, config.n_obs_steps
        )


def require_lerobot_weights(
    config: LeRobotConfig, vision: VisionConfig | None, text: TextConfig, weights: Mapping[str, torch.Tensor]
) -> None:
    """Raise unless the weights are those of the network that is configured.

    The network is made on the meta device: shapes, and no memory, whatever the configuration asks for.

    Args:
        config: of the policy; this and the next two as ``Network`` takes them.
        vision: of its image encoders.
        text: of its text encoder.
        weights: of ``read_weights``.

    Raises:
        CheckpointError: more layers than any policy has, or weights that do not fit; names them.
    """
    eyes = 0 if vision is None else vision.num_hidden_layers
    if config.separate_encoders:
        eyes *= len(config.cameras)
    layers = config.network.num_layers + text.num_hidden_layers + eyes
    if layers > _MOST_LAYERS:
        raise CheckpointError(
            f"the configuration asks for {layers} layers, {eyes} of them of image encoders; expected {_MOST_LAYERS} at"
            " most. config.json, or the encoder's, is of another network than the one that was saved."
        )
    with torch.device("meta"):
        expected = Network(config, vision, text).state_dict()
    require_weights(expected, weights, "config.json, or the encoder's,")
