"""Checkpoints of Diffusion Policy's U-Nets with weights that a seed gives, so that golden files stay small.

``golden/make_unets.py`` gives the original implementations the same weights, observations and noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ttscompile.frontends.conditional_unet1d import ConditionalUnet1D, UNetConfig

from .hybrid import Array, fill

STREAMS, STEPS, OBSERVED, ACTION = 2, 6, 2, 3
LOW_DIM = 5
_POLICY = "diffusion_policy.policy.diffusion_unet_lowdim_policy.DiffusionUnetLowdimPolicy"
_NETWORK = "diffusion_policy.model.diffusion.conditional_unet1d.ConditionalUnet1D"
_TINY = {"diffusion_step_embed_dim": 16, "down_dims": [16, 24], "kernel_size": 3, "n_groups": 4}

VARIANTS: dict[str, dict[str, Any]] = {
    # Three levels, FiLM without scales, DDIM, and a sample of the executed steps alone.
    "steps_only": {
        "policy": {"obs_as_global_cond": True, "pred_action_steps_only": True, "oa_step_convention": True},
        "model": {"down_dims": [8, 16, 24], "kernel_size": 5, "cond_predict_scale": False, "n_groups": 8},
        "scheduler": "DDIMScheduler",
    },
    # Without oa_step_convention the first step after the observed ones is executed first.
    "local": {"policy": {"obs_as_local_cond": True}, "model": {"cond_predict_scale": True}},
    "inpainting": {"policy": {}, "model": {"cond_predict_scale": True}},
}


def scheduler(name: str) -> dict[str, Any]:
    """Settings of a scheduler."""
    return {
        "_target_": f"diffusers.schedulers.{name}",
        # Ten times the steps taken: the first of them all divides by next to nothing, which magnifies rounding.
        "num_train_timesteps": 10 * STEPS,
        "beta_start": 0.0001,
        "beta_end": 0.02,
        "beta_schedule": "squaredcos_cap_v2",
        "clip_sample": True,
        "clip_sample_range": 4.0,  # wide, so that few actions are where clipping hides what made them
        "prediction_type": "epsilon",
    }


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made = VARIANTS[variant]
    as_global, as_local = (made["policy"].get(f"obs_as_{name}_cond", False) for name in ("global", "local"))
    model = {
        "_target_": _NETWORK,
        "input_dim": ACTION + (0 if as_global or as_local else LOW_DIM),
        "global_cond_dim": LOW_DIM * OBSERVED if as_global else None,
        "local_cond_dim": LOW_DIM if as_local else None,
        **_TINY,
        **made["model"],
    }
    policy = {
        "_target_": _POLICY,
        "model": model,
        "noise_scheduler": scheduler(made.get("scheduler", "DDPMScheduler")),
        "num_inference_steps": STEPS,
        "horizon": 8,
        "obs_dim": LOW_DIM,
        "action_dim": ACTION,
        "n_action_steps": 4,
        "n_obs_steps": OBSERVED,
        **made["policy"],
    }
    return {"training": {"use_ema": True}, "policy": policy}


def state_dict(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights as the original saves them, normalisers among them."""
    model = {key: value for key, value in configuration(variant)["policy"]["model"].items() if key != "_target_"}
    network = ConditionalUnet1D(UNetConfig(**model))
    weights = fill({f"model.{key}": value for key, value in network.state_dict().items()}, seed)
    weights |= {"_dummy_variable": torch.zeros(0), "mask_generator._dummy_variable": torch.zeros(0)}
    return weights | normalizer({"obs": LOW_DIM, "action": ACTION})


def normalizer(widths: dict[str, int]) -> dict[str, torch.Tensor]:
    """Scale and offset of every field, by its width."""
    return {
        f"normalizer.params_dict.{key}.{name}": torch.linspace(low, high, width)
        for key, width in widths.items()
        for name, low, high in (("scale", 0.5, 2.0), ("offset", -0.4, 0.3))
    }


def observation(variant: str) -> dict[str, Array]:
    """What the policy is given."""
    rng = np.random.RandomState(7)
    return {"obs": rng.uniform(-1, 1, (STREAMS, OBSERVED, LOW_DIM)).astype(np.float32)}


def noise(sample: tuple[int, int]) -> tuple[Array, Array]:
    """``[B, T, D]`` and ``[K, B, T, D]``."""
    rng = np.random.RandomState(11)
    shape = (STREAMS, *sample)
    return rng.standard_normal(shape).astype(np.float32), rng.standard_normal((STEPS, *shape)).astype(np.float32)


def payload(variant: str) -> dict[str, Any]:
    """A checkpoint before it is saved."""
    states = {"model": state_dict(variant, 1), "ema_model": state_dict(variant)}
    return {"cfg": configuration(variant), "state_dicts": states, "pickles": {}}
