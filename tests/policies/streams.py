"""Streaming Diffusion Policy at tiny sizes: its checkpoints, with weights that a seed gives, and what it observes.

``tests/families/golden/make_streaming.py`` gives the original the same.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from tests.families.checks import Arrays, golden, part
from tests.families.weights import draw_weights
from tests.policies import hybrid
from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig

SEED, STREAMS, CALLS, OBS, ACTION = 41, 2, 3, 5, 3
_PACKAGE = "diffusion_policy"

VARIANTS: dict[str, dict[str, Any]] = {
    # Two chunks of three steps behind one that is observed, and a step that is left over.
    "two_chunks": {
        "policy": {"horizon": 8, "n_obs_steps": 2, "n_action_steps": 3},
        "scheduler": {"num_train_timesteps": 10},
    },
    # Three chunks; the network predicts the sample, nothing is clipped, and more noise is added.
    "three_chunks": {
        "policy": {"horizon": 12, "n_obs_steps": 1, "n_action_steps": 4, "buffer_init": "constant"},
        "scheduler": {
            "num_train_timesteps": 12,
            "prediction_type": "sample",
            "clip_sample": False,
            "variance_type": "fixed_large",
            "beta_schedule": "linear",
        },
    },
    "images": {
        "obs": {"pos": {"shape": [4]}, "front": {"shape": [3, 40, 43], "type": "rgb"}},
        "policy": {
            "horizon": 8,
            "n_obs_steps": 2,
            "n_action_steps": 3,
            "crop_shape": [34, 36],
            "obs_encoder_group_norm": True,
            "eval_fixed_crop": True,
        },
        "scheduler": {"num_train_timesteps": 10, "variance_type": "fixed_small_log"},
    },
}
LOW = ("two_chunks", "three_chunks")
_TINY: dict[str, Any] = {"diffusion_step_embed_dim": 16, "down_dims": [16, 24], "kernel_size": 3, "n_groups": 4}


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made = copy.deepcopy(VARIANTS[variant])
    scheduler = {
        "_target_": f"{_PACKAGE}.policy.schedulers.DDPMTEDiScheduler",
        "beta_start": 0.0001,
        "beta_end": 0.02,
        "beta_schedule": "squaredcos_cap_v2",
        "variance_type": "fixed_small",
        "clip_sample": True,
        "prediction_type": "epsilon",
        **made["scheduler"],
    }
    shape = made["policy"]
    common = {
        "num_inference_steps": scheduler["num_train_timesteps"],
        "obs_as_global_cond": True,
        "temporally_constant_weight": 0.2,
        "temporally_increasing_weight": 0.0,
        "temporally_random_weights": 0.0,
        "chunk_wise_weight": 0.8,
        "buffer_init": "zero",
        "noise_scheduler": scheduler,
        **shape,
    }
    if variant not in LOW:
        target = f"{_PACKAGE}.policy.tedi_unet_hybrid_image_policy.TEDIUnetHybridImagePolicy"
        shapes = {"obs": made["obs"], "action": {"shape": [ACTION]}}
        return {
            "training": {"use_ema": True},
            "policy": {"_target_": target, "shape_meta": shapes, "cond_predict_scale": True, **_TINY, **common},
        }
    model = {
        "_target_": f"{_PACKAGE}.model.diffusion.conditional_unet1d_tedi.ConditionalUnet1D",
        "input_dim": ACTION,
        "local_cond_dim": None,
        "global_cond_dim": OBS * shape["n_obs_steps"],
        "cond_predict_scale": True,
        "horizon": shape["horizon"],
        **_TINY,
    }
    policy = {
        "_target_": f"{_PACKAGE}.policy.tedi_unet_lowdim_policy.TEDiUnetLowdimPolicy",
        "obs_dim": OBS,
        "action_dim": ACTION,
        "obs_as_local_cond": False,
        "pred_action_steps_only": False,
        "oa_step_convention": True,
        "model": model,
        **common,
    }
    return {"training": {"use_ema": True}, "policy": policy}


def network(variant: str) -> dict[str, torch.Tensor]:
    """The weights, under the names of the original."""
    policy, encoded = configuration(variant)["policy"], {}
    width = OBS
    if variant not in LOW:
        encoder = hybrid.build_encoder(policy)
        width, encoded = encoder.width, hybrid.encoder_weights(encoder, SEED)
    config = UNetConfig(
        input_dim=ACTION, global_cond_dim=width * policy["n_obs_steps"], cond_predict_scale=True, **_TINY
    )
    own, turned = ConditionalUnet1D(config), (nn.Identity(), nn.Identity(), nn.Identity())
    first = nn.Linear(16 * policy["horizon"], 64)
    own.diffusion_step_encoder = nn.Sequential(*turned, first, nn.Mish(), nn.Linear(64, 16))
    shapes = {f"model.{name}": tuple(value.shape) for name, value in own.state_dict().items()}
    return encoded | draw_weights(shapes, SEED)


def normalizer(variant: str) -> dict[str, torch.Tensor]:
    """Scale and offset of states, images and actions."""
    observed = VARIANTS[variant].get("obs", {"obs": {"shape": [OBS]}})
    widths = {key: 1 if each.get("type") == "rgb" else each["shape"][0] for key, each in observed.items()}
    return {
        f"normalizer.params_dict.{key}.{name}": torch.linspace(low, high, width)
        for key, width in (widths | {"action": ACTION}).items()
        for name, low, high in (("scale", 0.5, 2.0), ("offset", -0.4, 0.3))
    }


def payload(variant: str, **changes: Any) -> dict[str, Any]:
    """A checkpoint; ``changes`` to ``cfg.policy``, those of its scheduler and of its model by their names."""
    config = configuration(variant)
    for name in ("noise_scheduler", "model"):
        config["policy"].get(name, {}).update(changes.pop(name, {}))
    config["policy"].update(changes)
    states = network(variant) | normalizer(variant) | {"_dummy_variable": torch.zeros(0)}
    return {"cfg": config, "state_dicts": {"model": states, "ema_model": states}, "pickles": {}}


def save(path: Path, variant: str, **changes: Any) -> Path:
    """The same in a file."""
    torch.save(payload(variant, **changes), path)
    return path


def observations(variant: str) -> list[Arrays]:
    """Of consecutive calls, each ``[streams, To, ...]``; images of 0..1."""
    made, rng = VARIANTS[variant], np.random.default_rng(SEED + 1)
    shapes = {key: each["shape"] for key, each in made.get("obs", {"obs": {"shape": [OBS]}}).items()}
    steps, low = made["policy"]["n_obs_steps"], -1.0 if variant in LOW else 0.0
    return [
        {key: rng.uniform(low, 1, (STREAMS, steps, *shape)).astype(np.float32) for key, shape in shapes.items()}
        for _ in range(CALLS)
    ]


def draws(variant: str) -> np.ndarray:
    """Noise in the order in which the original draws it: of whole buffers, of which it takes as many as it wants."""
    made = VARIANTS[variant]
    shape = (100, STREAMS, made["policy"]["horizon"], ACTION)
    return np.random.default_rng(SEED + 2).standard_normal(shape, dtype=np.float32)


def expected(variant: str) -> Arrays:
    """What the original gave."""
    return part(golden("streaming"), variant)
