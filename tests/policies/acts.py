"""LeRobot's ``act`` policies with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_act.py`` gives lerobot the same directories and observations.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ttscompile.policies.lerobot.act import ACT, ACTConfig, as_saved, read_config
from ttscompile.policies.lerobot.config import ENVIRONMENT, STATE

from .hybrid import Array, fill
from .lerobot_tiny import observe_variant, save_variant

STREAMS, STATE_DIM, ACTION_DIM, CHUNK = 2, 4, 3, 6
TOP, WRIST = "observation.images.top", "observation.images.wrist"
_STANDARD, _RANGE = "MEAN_STD", "MIN_MAX"

VARIANTS: dict[str, dict[str, Any]] = {
    # lerobot's defaults, but for the config: two cameras, the encoder of its variational autoencoder in the file.
    "two_cameras": {
        "inputs": {STATE: ("STATE", [STATE_DIM]), TOP: ("VISUAL", [3, 49, 70]), WRIST: ("VISUAL", [3, 49, 70])},
        "modes": {"VISUAL": _STANDARD, "STATE": _STANDARD, "ACTION": _STANDARD},
        "renamed": {"observation.images.front": TOP, "observation.arm": STATE},
        "settings": {"n_action_steps": 4},
    },
    # All that differs from the defaults: the deeper ResNet, norms first, GELU, two layers of the decoder,
    # no autoencoder, cameras of two shapes, and the environment beside the state.
    "others": {
        "inputs": {
            WRIST: ("VISUAL", [3, 40, 33]),
            ENVIRONMENT: ("ENV", [2]),
            STATE: ("STATE", [STATE_DIM]),
            TOP: ("VISUAL", [3, 33, 65]),
        },
        "modes": {"VISUAL": _RANGE, "STATE": _RANGE, "ACTION": _RANGE, "ENV": _STANDARD},
        "settings": {
            "vision_backbone": "resnet34",
            "pre_norm": True,
            "feedforward_activation": "gelu",
            "n_decoder_layers": 2,
            "use_vae": False,
        },
    },
    # A camera alone.
    "stateless": {
        "inputs": {TOP: ("VISUAL", [3, 65, 33])},
        "modes": {"VISUAL": _STANDARD, "ACTION": "QUANTILES"},
        "settings": {},
    },
    # The environment alone beside the state; no camera, so the width is no multiple of four.
    "states": {
        "inputs": {STATE: ("STATE", [STATE_DIM]), ENVIRONMENT: ("ENV", [5])},
        "modes": {"STATE": "QUANTILES", "ACTION": "QUANTILE10"},
        "settings": {"dim_model": 30, "n_heads": 3},
    },
}

_BASE: dict[str, Any] = {
    "type": "act",
    "device": "cpu",
    "n_obs_steps": 1,
    "chunk_size": CHUNK,
    "n_action_steps": CHUNK,
    "vision_backbone": "resnet18",
    "pretrained_backbone_weights": None,
    "replace_final_stride_with_dilation": 0,  # lerobot's own default
    "pre_norm": False,
    "dim_model": 32,
    "n_heads": 4,
    "dim_feedforward": 48,
    "feedforward_activation": "relu",
    "n_encoder_layers": 2,
    "n_decoder_layers": 1,
    "use_vae": True,
    "latent_dim": 8,
    "n_vae_encoder_layers": 1,
    "temporal_ensemble_coeff": None,
}


def save(variant: str, directory: Path) -> Path:
    """Save a policy as lerobot does. Returns the directory."""
    made = VARIANTS[variant]
    return save_variant(directory, made, {**made["inputs"], "action": ("ACTION", [ACTION_DIM])}, _BASE, _weights)


def config_of(directory: Path) -> ACTConfig:
    """The configuration as it is read."""
    return read_config(directory, json.loads((directory / "config.json").read_text(encoding="utf-8")))[1]


def _weights(directory: Path) -> dict[str, torch.Tensor]:
    """Under lerobot's names, with those that are evaluated in training alone."""
    config = config_of(directory)
    with torch.device("meta"):
        shapes = as_saved(ACT(config))
        if json.loads((directory / "config.json").read_text(encoding="utf-8"))["use_vae"]:
            shapes |= _autoencoder(config)
    return fill(shapes, 0)


def _autoencoder(config: ACTConfig) -> dict[str, torch.Tensor]:
    """The weights of lerobot's ``vae_encoder``, a row of layers like those of the encoder."""
    width, state = config.dim_model, config.vectors.get("robot")
    alike = ACT(replace(config, n_encoder_layers=_BASE["n_vae_encoder_layers"])).encoder.state_dict()
    shapes = {f"vae_encoder.{name}": value for name, value in alike.items()}
    shapes["vae_encoder_cls_embed.weight"] = torch.empty(1, width)
    shapes["vae_encoder_pos_enc"] = torch.empty(1, 1 + CHUNK + (state is not None), width)
    linears = {"action_input": (width, ACTION_DIM), "latent_output": (2 * config.latent_dim, width)}
    linears |= {} if state is None else {"robot_state_input": (width, state)}
    for name, shape in linears.items():
        shapes[f"vae_encoder_{name}_proj.weight"] = torch.empty(shape)
        shapes[f"vae_encoder_{name}_proj.bias"] = torch.empty(shape[0])
    return {f"model.{name}": value for name, value in shapes.items()}


def observation(variant: str) -> dict[str, Array]:
    """Windows of one frame by the robot's names, images in 0..1."""
    made = VARIANTS[variant]
    return observe_variant(made, {key: (STREAMS, 1, *shape) for key, (_, shape) in made["inputs"].items()})
