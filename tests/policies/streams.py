"""Streaming Diffusion Policy at tiny sizes: its checkpoints, with weights that a seed gives, and what it observes.

``tests/families/golden/make_streaming.py`` gives the original the same.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from tests.families.checks import Arrays, golden
from tests.families.weights import draw_weights
from ttscompile.frontends.conditional_unet1d import ConditionalUnet1D, UNetConfig

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
}


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
    model = {
        "_target_": f"{_PACKAGE}.model.diffusion.conditional_unet1d_tedi.ConditionalUnet1D",
        "input_dim": ACTION,
        "local_cond_dim": None,
        "global_cond_dim": OBS * shape["n_obs_steps"],
        "diffusion_step_embed_dim": 16,
        "down_dims": [16, 24],
        "kernel_size": 3,
        "n_groups": 4,
        "cond_predict_scale": True,
        "horizon": shape["horizon"],
    }
    policy = {
        "_target_": f"{_PACKAGE}.policy.tedi_unet_lowdim_policy.TEDiUnetLowdimPolicy",
        "obs_dim": OBS,
        "action_dim": ACTION,
        "num_inference_steps": scheduler["num_train_timesteps"],
        "obs_as_local_cond": False,
        "obs_as_global_cond": True,
        "pred_action_steps_only": False,
        "oa_step_convention": True,
        "temporally_constant_weight": 0.2,
        "temporally_increasing_weight": 0.0,
        "temporally_random_weights": 0.0,
        "chunk_wise_weight": 0.8,
        "buffer_init": "zero",
        "model": model,
        "noise_scheduler": scheduler,
        **shape,
    }
    return {"training": {"use_ema": True}, "policy": policy}


def network(variant: str) -> dict[str, torch.Tensor]:
    """The weights of ``model``, under the names of the original."""
    model = configuration(variant)["policy"]["model"]
    horizon = model.pop("horizon")
    own = ConditionalUnet1D(UNetConfig(**{name: value for name, value in model.items() if name != "_target_"}))
    turned = (nn.Identity(), nn.Identity(), nn.Identity())
    own.diffusion_step_encoder = nn.Sequential(*turned, nn.Linear(16 * horizon, 64), nn.Mish(), nn.Linear(64, 16))
    return draw_weights({f"model.{name}": tuple(value.shape) for name, value in own.state_dict().items()}, SEED)


def normalizer() -> dict[str, torch.Tensor]:
    """Scale and offset of states and actions."""
    return {
        f"normalizer.params_dict.{key}.{name}": torch.linspace(low, high, width)
        for key, width in (("obs", OBS), ("action", ACTION))
        for name, low, high in (("scale", 0.5, 2.0), ("offset", -0.4, 0.3))
    }


def payload(variant: str, **changes: Any) -> dict[str, Any]:
    """A checkpoint; ``changes`` to ``cfg.policy``, those of its scheduler and of its model by their names."""
    config = configuration(variant)
    for name in ("noise_scheduler", "model"):
        config["policy"][name].update(changes.pop(name, {}))
    config["policy"].update(changes)
    states = network(variant) | normalizer() | {"_dummy_variable": torch.zeros(0)}
    return {"cfg": config, "state_dicts": {"model": states, "ema_model": states}, "pickles": {}}


def save(path: Path, variant: str, **changes: Any) -> Path:
    """The same in a file."""
    torch.save(payload(variant, **changes), path)
    return path


def observations(variant: str) -> np.ndarray:
    """Of consecutive calls, ``[calls, streams, To, Do]``."""
    shape = (CALLS, STREAMS, VARIANTS[variant]["policy"]["n_obs_steps"], OBS)
    return np.random.default_rng(SEED + 1).uniform(-1, 1, shape).astype(np.float32)


def draws(variant: str) -> np.ndarray:
    """Noise in the order in which the original draws it: of whole buffers, of which it takes as many as it wants."""
    made = VARIANTS[variant]
    shape = (100, STREAMS, made["policy"]["horizon"], ACTION)
    return np.random.default_rng(SEED + 2).standard_normal(shape, dtype=np.float32)


def expected(variant: str) -> Arrays:
    """What the original gave."""
    numbers = golden("streaming").items()
    return {name.removeprefix(f"{variant}."): value for name, value in numbers if name.startswith(f"{variant}.")}
