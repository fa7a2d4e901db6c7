"""LeRobot's ``diffusion`` policies with weights that a seed gives, so that golden files stay small.

``golden/make_lerobot_unets.py`` gives lerobot the same directories, observations and noise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ttscompile.policies.lerobot.diffusion import DiffusionConfig, Network, as_saved, read_config

from .hybrid import Array, fill
from .lerobot_tiny import observe_variant, save_variant

STREAMS, STEPS, STATE_DIM, ACTION_DIM = 2, 6, 4, 3
STATE, ENVIRONMENT = "observation.state", "observation.environment_state"
TOP, WRIST = "observation.images.top", "observation.images.wrist"
_STANDARD, _RANGE = "MEAN_STD", "MIN_MAX"

VARIANTS: dict[str, dict[str, Any]] = {
    # One encoder for two cameras, batch norm, a crop of what is resized, DDPM.
    "one_encoder": {
        "inputs": {TOP: ("VISUAL", [3, 41, 47]), WRIST: ("VISUAL", [3, 41, 47])},
        "modes": {"VISUAL": _STANDARD, "STATE": _RANGE, "ACTION": _RANGE},
        "renamed": {"observation.images.front": TOP, "observation.arm": STATE},
        "settings": {
            "use_separate_rgb_encoder_per_camera": False,
            "resize_shape": [46, 75],
            "crop_ratio": 0.9,
            "crop_shape": [41, 67],
            "spatial_softmax_num_keypoints": 5,
        },
    },
    # An encoder for each, group norm, a crop with odd margins, DDIM, no scales in FiLM, a prediction of the sample.
    "separate": {
        "inputs": {WRIST: ("VISUAL", [3, 43, 38]), ENVIRONMENT: ("ENV", [2]), TOP: ("VISUAL", [3, 43, 38])},
        "modes": {"VISUAL": _RANGE, "STATE": _STANDARD, "ACTION": _STANDARD, "ENV": _RANGE},
        "settings": {
            "n_obs_steps": 1,
            "use_group_norm": True,
            "crop_shape": [36, 33],
            "noise_scheduler_type": "DDIM",
            "prediction_type": "sample",
            "use_film_scale_modulation": False,
            "down_dims": [8, 16, 24],
            "n_groups": 4,
            "kernel_size": 3,
        },
    },
    # The deeper ResNet on whole images, an unbounded sample, one level.
    "deeper": {
        "inputs": {TOP: ("VISUAL", [3, 33, 40])},
        "modes": {"VISUAL": _STANDARD, "STATE": _RANGE, "ACTION": _RANGE},
        "settings": {
            "vision_backbone": "resnet34",
            "noise_scheduler_type": "DDIM",
            "clip_sample": False,
            "down_dims": [16],
            "n_obs_steps": 3,
        },
    },
    # States alone; the environment's is not normalised, as the default of lerobot has it.
    "states": {
        "inputs": {ENVIRONMENT: ("ENV", [5])},
        "modes": {"STATE": "QUANTILES", "ACTION": "QUANTILE10"},
        "settings": {},
    },
}

_BASE: dict[str, Any] = {
    "type": "diffusion",
    "device": "cpu",
    "n_obs_steps": 2,
    "horizon": 8,
    "n_action_steps": 4,
    "vision_backbone": "resnet18",
    "pretrained_backbone_weights": None,
    "spatial_softmax_num_keypoints": 8,
    "down_dims": [16, 24],
    "kernel_size": 5,
    "n_groups": 8,
    "diffusion_step_embed_dim": 16,
    "noise_scheduler_type": "DDPM",
    # Ten times the steps taken: the first of them all divides by next to nothing, which magnifies rounding.
    "num_train_timesteps": 10 * STEPS,
    "num_inference_steps": STEPS,
    "clip_sample_range": 4.0,  # wide, so that few actions are where clipping hides what made them
}


def save(variant: str, directory: Path) -> Path:
    """Save a policy as lerobot does. Returns the directory."""
    made = VARIANTS[variant]
    features = {STATE: ("STATE", [STATE_DIM]), **made["inputs"], "action": ("ACTION", [ACTION_DIM])}
    return save_variant(directory, made, features, _BASE, lambda saved: _weights(read(saved)))


def read(directory: Path) -> DiffusionConfig:
    """The configuration as it is read."""
    return read_config(directory, json.loads((directory / "config.json").read_text(encoding="utf-8")))


def _weights(config: DiffusionConfig) -> dict[str, torch.Tensor]:
    """Under lerobot's names, with the counters of its batch norms."""
    shapes = as_saved(Network(config))
    grids = {name: value.contiguous() for name, value in shapes.items() if name.endswith("pos_grid")}
    drawn = fill({name: value for name, value in shapes.items() if name not in grids}, 0)
    counters = [name.replace("running_mean", "num_batches_tracked") for name in drawn if name.endswith("running_mean")]
    return drawn | grids | {name: torch.tensor(7) for name in counters}


def observation(variant: str) -> dict[str, Array]:
    """Windows by the robot's names, images in 0..1."""
    made = VARIANTS[variant]
    frames = made["settings"].get("n_obs_steps", _BASE["n_obs_steps"])
    shapes = {STATE: [STATE_DIM], **{key: shape for key, (_, shape) in made["inputs"].items()}}
    return observe_variant(made, {key: (STREAMS, frames, *shape) for key, shape in shapes.items()})


def noise() -> tuple[Array, Array]:
    """``[B, T, D]`` and ``[K, B, T, D]``."""
    rng = np.random.RandomState(11)
    shape = (STREAMS, _BASE["horizon"], ACTION_DIM)
    return rng.standard_normal(shape).astype(np.float32), rng.standard_normal((STEPS, *shape)).astype(np.float32)
