"""Checkpoints of Diffusion Policy's image transformer with weights that a seed gives, so that golden files stay small.

``golden/make_hybrid.py`` gives the original implementation the same weights, observations and noise.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ttscompile.policies.diffusion_policy.hybrid import FEATURES, CameraEncoder, ObservationEncoder
from ttscompile.policies.networks.resnet import group_norm
from ttscompile.policies.networks.transformer_for_diffusion import TransformerConfig, TransformerForDiffusion

Array = npt.NDArray[np.float32]

STREAMS = 2
STEPS = 6
ACTION = 3
_TWINS = {"backbone.": "nets.0.", "pool.": "nets.1.", "linear.": "nets.3."}
_SMALL = {"n_layer": 2, "n_head": 2, "n_emb": 32, "horizon": 4, "n_action_steps": 2, "n_obs_steps": 2}

VARIANTS: dict[str, dict[str, Any]] = {
    # Two cameras with a low-dimensional key between them; odd margins, of which the crop rounds halves to even.
    "two_cameras": {
        "obs": {
            "wrist": {"shape": [3, 41, 43], "type": "rgb"},
            "pos": {"shape": [4], "type": "low_dim"},
            "front": {"shape": [3, 41, 43], "type": "rgb"},
        },
        "image": (2.0, -1.0),
        "policy": {"crop_shape": [36, 36], "obs_encoder_group_norm": True, "eval_fixed_crop": True},
        "scheduler": "DDPMScheduler",
    },
    # Batch norm, the whole image, and the observation inside the sample.
    "batch_norm_inpainting": {
        "obs": {"front": {"shape": [3, 34, 65], "type": "rgb"}, "pos": {"shape": [2]}},
        "image": (1.0, 0.0),
        "policy": {"crop_shape": None, "obs_as_cond": False, "causal_attn": True},
        "scheduler": "DDIMScheduler",
    },
    "action_steps_only": {
        "obs": {"pos": {"shape": [4]}, "front": {"shape": [1, 40, 48], "type": "rgb"}},
        "image": (2.0, -1.0),
        "policy": {
            "crop_shape": [33, 38],
            "obs_encoder_group_norm": True,
            "eval_fixed_crop": True,
            "pred_action_steps_only": True,
            "causal_attn": False,
            "n_cond_layers": 1,
        },
        "scheduler": "DDPMScheduler",
    },
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
    return {
        "training": {"use_ema": True},
        "policy": {
            "_target_": "diffusion_policy.policy.diffusion_transformer_hybrid_image_policy"
            ".DiffusionTransformerHybridImagePolicy",
            "shape_meta": {"obs": made["obs"], "action": {"shape": [ACTION]}},
            "noise_scheduler": scheduler(made["scheduler"]),
            "num_inference_steps": STEPS,
            **_SMALL,
            **made["policy"],
        },
    }


def state_dict(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights as the original saves them: image encoders twice, normalisers and masks among them."""
    config = configuration(variant)["policy"]
    encoder = build_encoder(config)
    as_cond = config.get("obs_as_cond", True)
    channels = ACTION + (0 if as_cond else encoder.width)
    names = ("n_layer", "n_head", "n_emb", "horizon", "n_obs_steps")
    network = TransformerForDiffusion(
        TransformerConfig(
            input_dim=channels,
            output_dim=channels,
            cond_dim=encoder.width if as_cond else 0,
            causal_attn=config.get("causal_attn", True),
            n_cond_layers=config.get("n_cond_layers", 0),
            **{name: config[name] for name in names},
        )
    )
    weights = fill({f"model.{key}": value for key, value in network.state_dict().items()}, seed)
    weights |= {"_dummy_variable": torch.zeros(0), "model._dummy_variable": torch.zeros(0)}
    return weights | encoder_weights(encoder, seed) | normalizer(variant)


def encoder_weights(encoder: ObservationEncoder, seed: int) -> dict[str, torch.Tensor]:
    """Those of robomimic's encoder, as the original saves them."""
    weights = {}
    for key, position in encoder.position.items():
        prefix = f"obs_encoder.obs_nets.{key}."
        once = fill({prefix + name: v for name, v in encoder.cameras[position].state_dict().items()}, seed)
        for name, value in once.items():
            part = next(part for part in _TWINS if name.startswith(prefix + part))
            weights[prefix + _TWINS[part] + name.removeprefix(prefix + part)] = value
            if part != "linear.":
                weights[name] = value
    return weights


def build_encoder(config: Mapping[str, Any]) -> ObservationEncoder:
    """robomimic's encoder of ``cfg.policy``."""
    obs = config["shape_meta"]["obs"]
    crop = None if config["crop_shape"] is None else tuple(config["crop_shape"])
    norm = group_norm if config.get("obs_encoder_group_norm", False) else torch.nn.BatchNorm2d
    inputs = {
        key: CameraEncoder(tuple(each["shape"]), crop, norm) if each.get("type") == "rgb" else math.prod(each["shape"])
        for key, each in obs.items()
    }
    return ObservationEncoder(inputs)


def fill(shapes: Mapping[str, torch.Tensor], seed: int) -> dict[str, torch.Tensor]:
    """Every weight from a generator of its own, seeded by its name: the order does not matter.

    Masks, grids, counters and temperatures keep their values. Scales are such that every block matters.
    """
    kept = ("mask", "pos_x", "pos_y", "num_batches_tracked", "temperature", "_dummy_variable")
    return {
        name: value if name.endswith(kept) else torch.from_numpy(drawn(name, tuple(value.shape), seed).copy())
        for name, value in shapes.items()
    }


@lru_cache(maxsize=4096)
def drawn(name: str, shape: tuple[int, ...], seed: int) -> npt.NDArray[np.float32]:
    """The same numbers again and again, where each test of a file fills the network that all of them are about."""
    # numpy's legacy generator: its numbers are frozen for all versions.
    rng = np.random.RandomState(sum(ord(c) * (i + 1) for i, c in enumerate(name)) + seed)
    numbers = rng.uniform(-1, 1, shape).astype(np.float32)
    if name.endswith("running_var"):
        numbers = 1.0 + 0.5 * numbers
    elif len(shape) == 1 and name.endswith("weight"):
        numbers = 1.0 + 0.4 * numbers
    elif len(shape) == 1:
        numbers = 0.2 * numbers
    else:
        gain = 5.0 if "pool." in name or "nets.1.nets" in name else 2.0  # keypoints that move
        numbers = numbers * gain / math.sqrt(max(math.prod(shape[1:]), 1))
    return np.asarray(numbers, np.float32)


def normalizer(variant: str) -> dict[str, torch.Tensor]:
    """Scale and offset of every key and of the action."""
    made = VARIANTS[variant]
    fields: dict[str, Any] = {}
    for key, attributes in made["obs"].items():
        if attributes.get("type") == "rgb":
            fields[key] = [np.array([value], np.float32) for value in made["image"]]
        else:
            (width,) = attributes["shape"]
            fields[key] = (np.linspace(0.5, 2, width), np.linspace(-0.4, 0.3, width))
    fields["action"] = (np.linspace(0.5, 2, ACTION), np.linspace(-1, 1, ACTION))
    return {
        f"normalizer.params_dict.{key}.{name}": torch.from_numpy(np.asarray(value, np.float32))
        for key, pair in fields.items()
        for name, value in zip(("scale", "offset"), pair, strict=True)
    }


def observation(variant: str) -> dict[str, Array]:
    """What the policy is given, images in 0..1."""
    rng = np.random.RandomState(7)
    return {
        key: rng.uniform(0, 1, (STREAMS, 2, *each["shape"])).astype(np.float32)
        for key, each in VARIANTS[variant]["obs"].items()
    }


def noise(variant: str) -> tuple[Array, Array]:
    """``[B, T, D]`` and ``[K, B, T, D]``."""
    policy = configuration(variant)["policy"]
    cameras = sum(each.get("type") == "rgb" for each in VARIANTS[variant]["obs"].values())
    low_dim = sum(each["shape"][0] for each in VARIANTS[variant]["obs"].values() if each.get("type") != "rgb")
    channels = ACTION if policy.get("obs_as_cond", True) else ACTION + FEATURES * cameras + low_dim
    length = policy["n_action_steps"] if policy.get("pred_action_steps_only") else policy["horizon"]
    rng = np.random.RandomState(11)
    shape = (STREAMS, length, channels)
    return rng.standard_normal(shape).astype(np.float32), rng.standard_normal((STEPS, *shape)).astype(np.float32)


def payload(variant: str) -> dict[str, Any]:
    """A checkpoint before it is saved."""
    return {"cfg": configuration(variant), "state_dicts": {"ema_model": state_dict(variant)}, "pickles": {}}
