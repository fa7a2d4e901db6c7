"""Checkpoints of Consistency Policy with weights that a seed gives, so that golden files stay small.

``golden/make_consistency_policy.py`` gives the original implementation the same weights, observations and noise.
"""

import copy
from typing import Any

import numpy as np
import torch

from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig

from . import hybrid, unets
from .hybrid import Array

STREAMS, OBSERVED, ACTION, HORIZON = 2, 2, 3, 8
OBS: dict[str, Any] = {"pos": {"shape": [4]}, "front": {"shape": [3, 40, 43], "type": "rgb"}}
_TINY: dict[str, Any] = {"diffusion_step_embed_dim": 16, "down_dims": [16, 24], "kernel_size": 3, "n_groups": 4}
_TEACHER = "teacher.edm_policy.KarrasUnetHybridImagePolicy"
_STUDENT = "student.ctm_policy.CTMPPUnetHybridImagePolicy"

VARIANTS: dict[str, dict[str, Any]] = {
    # Predictions so large that the bound cuts many.
    "heun": {"scheduler": {"solver": "heun", "bins": 8}, "gain": 1.2},
    # As their configurations have it: 158 evaluations.
    "heun_80": {"scheduler": {"solver": "second_order"}},
    "euler": {"scheduler": {"solver": "euler", "bins": 8, "scaling": "no_boundary"}},
    "third": {"scheduler": {"solver": "third", "bins": 5}},
    "fourth": {"scheduler": {"solver": "fourth", "bins": 5}},
    "student": {},
    "student_chained": {"chained": True},
    "student_chained_bins": {"policy": {"chaining_times": ["C", 27, 54, 70]}, "chained": True, "gain": 1.2},
}


def is_student(variant: str) -> bool:
    """Whether it is one."""
    return variant.startswith("student")


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made, student = VARIANTS[variant], is_student(variant)
    scheduler = {
        "_target_": f"consistency_policy.diffusion.{'CTM' if student else 'Karras'}_Scheduler",
        "time_min": 0.02,
        "time_max": 80.0,
        "rho": 7.0,
        "bins": 80,
        "solver": "heun",
        "time_sampler": "ctm" if student else "log_normal",
        "scaling": "boundary",
        "use_c_in": True,
        "data_std": 0.5,
        "clamp": True,
        **({"ode_steps_max": 1} if student else {"name": "heun80"}),
        **made.get("scheduler", {}),
    }
    policy = {
        "_target_": f"consistency_policy.{_STUDENT if student else _TEACHER}",
        "inference_mode": False,
        "cond_predict_scale": True,
        "crop_shape": [34, 36],
        "eval_fixed_crop": True,
        "horizon": HORIZON,
        "n_action_steps": 4,
        "n_obs_steps": OBSERVED,
        "delta": -1,
        "noise_scheduler": scheduler,
        "obs_as_global_cond": True,
        "obs_encoder_group_norm": True,
        "shape_meta": {"action": {"shape": [ACTION]}, "obs": copy.deepcopy(OBS)},
        **_TINY,
    }
    if student:
        policy |= {
            "dropout_rate": 0.2,
            "initial_ema_decay": 0.0,
            "special_skip": True,
            "chaining_times": ["D", 27, 54],
            "teacher_path": "teacher.ckpt",
            "use_kde": False,
            "kde_samples": 0,
            "edm": "teacher.ckpt",
            "losses": [["ctm", "dsm"], [1, 1]],
            "ctm_sampler": "ctm",
            "dsm_weights": "karras",
        }
    return {"training": {"use_ema": True, "inference_mode": False}, "policy": policy | made.get("policy", {})}


def state_dict(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights as the original saves them: of a student also those of its teacher, and averages of its own."""
    policy, student = configuration(variant)["policy"], is_student(variant)
    encoder = hybrid.build_encoder(policy)
    condition, width = OBSERVED * encoder.width, _TINY["diffusion_step_embed_dim"]
    networks = {"model": condition + width, "model_ema": condition + width, "teacher": condition}
    weights = {"_dummy_variable": torch.zeros(0), "mask_generator._dummy_variable": torch.zeros(0)}
    for prefix in networks if student else ("model",):
        global_cond = networks[prefix] if student else condition
        network = ConditionalUnet1D(UNetConfig(ACTION, None, global_cond, cond_predict_scale=True, **_TINY))
        named = hybrid.fill({f"{prefix}.{key}": value for key, value in network.state_dict().items()}, seed)
        gain = VARIANTS[variant].get("gain", 0.5)
        weights |= {name: value * (gain if "final_conv.1" in name else 1) for name, value in named.items()}
    widths = {key: 1 if each.get("type") == "rgb" else each["shape"][-1] for key, each in OBS.items()}
    return weights | hybrid.encoder_weights(encoder, seed) | unets.normalizer(widths | {"action": ACTION})


def observation() -> dict[str, Array]:
    """What the policy is given, images in 0..1."""
    rng = np.random.RandomState(7)
    return {key: rng.uniform(0, 1, (STREAMS, OBSERVED, *each["shape"])).astype(np.float32) for key, each in OBS.items()}


def noise(steps: int) -> tuple[Array, Array]:
    """``[B, T, Da]`` and ``[K, B, T, Da]``."""
    rng = np.random.RandomState(11)
    shape = (STREAMS, HORIZON, ACTION)
    return rng.standard_normal(shape).astype(np.float32), rng.standard_normal((steps, *shape)).astype(np.float32)


def payload(variant: str) -> dict[str, Any]:
    """A checkpoint before it is saved; the optimizer's state is saved, too, and a student has no averaged policy."""
    states: dict[str, Any] = {"model": state_dict(variant), "optimizer": {"state": {}, "param_groups": [{"lr": 1e-4}]}}
    if not is_student(variant):
        states |= {"model": state_dict(variant, 1), "ema_model": states["model"]}
    return {"cfg": configuration(variant), "state_dicts": states, "pickles": {"epoch": b"not even a pickle"}}
