"""Checkpoints of Diffusion Policy's U-Nets with weights that a seed gives, so that golden files stay small.

``golden/make_unets.py`` gives the original implementations the same weights, observations and noise.
"""

from typing import Any

import numpy as np
import torch

from ttscompile.policies.diffusion_policy.dp3 import PointCloudEncoder, PointNet
from ttscompile.policies.diffusion_policy.images import Camera, MultiImageEncoder
from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from ttscompile.policies.networks.resnet import group_norm

from . import hybrid
from .hybrid import Array

STREAMS, STEPS, OBSERVED, ACTION = 2, 6, 2, 3
LOW_DIM = 5
_ORIGINAL = "diffusion_policy"
_TINY = {"diffusion_step_embed_dim": 16, "down_dims": [16, 24], "kernel_size": 3, "n_groups": 4}
_HYBRID = "diffusion_unet_hybrid_image_policy.DiffusionUnetHybridImagePolicy"
_IMAGES = "diffusion_unet_image_policy.DiffusionUnetImagePolicy"
_DP3, _SIMPLE = "dp3.DP3", "simple_dp3.SimpleDP3"

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
    "hybrid": {
        "of": _HYBRID,
        "obs": {"pos": {"shape": [4]}, "front": {"shape": [3, 40, 43], "type": "rgb"}},
        "policy": {"crop_shape": [34, 36], "obs_encoder_group_norm": True, "eval_fixed_crop": True},
    },
    "hybrid_inpainting": {
        "of": _HYBRID,
        "obs": {"front": {"shape": [3, 33, 34], "type": "rgb"}, "pos": {"shape": [2]}},
        "policy": {"crop_shape": None, "obs_as_global_cond": False, "cond_predict_scale": False},
        "scheduler": "DDIMScheduler",
    },
    # Cameras, and what is no image, in another order than the features; odd margins.
    "images": {
        "of": _IMAGES,
        "obs": {
            "wrist": {"shape": [3, 41, 43], "type": "rgb"},
            "pos": {"shape": [4]},
            "front": {"shape": [3, 41, 43], "type": "rgb"},
            "grip": {"shape": [1]},
        },
        "encoder": {"crop_shape": [36, 36], "use_group_norm": True, "imagenet_norm": True},
        "policy": {},
    },
    # One deeper ResNet for both, which keeps its batch norm; images made smaller, and of no random crop none at all.
    "images_shared": {
        "of": _IMAGES,
        "obs": {"b": {"shape": [3, 50, 70], "type": "rgb"}, "a": {"shape": [3, 40, 30], "type": "rgb"}},
        "encoder": {
            "rgb_model": {"name": "resnet34"},
            "share_rgb_model": True,
            "use_group_norm": True,
            "resize_shape": [34, 36],
            "crop_shape": [20, 20],
            "random_crop": False,
        },
        "policy": {},
        "scheduler": "DDIMScheduler",
    },
    # Colours that are not looked at; points of the robot; a condition with a layer of its own, and not everywhere.
    "dp3": {
        "of": _DP3,
        "obs": {
            "agent_pos": {"shape": [4]},
            "point_cloud": {"shape": [20, 6], "type": "point_cloud"},
            "imagin_robot": {"shape": [5, 7], "type": "point_cloud"},
            "image": {"shape": [3, 84, 84], "type": "rgb"},
        },
        "policy": {
            "condition_type": "mlp_film",
            "use_mid_condition": False,
            "encoder_output_dim": 24,
            "pointcloud_encoder_cfg": {
                "in_channels": 3,
                "out_channels": 24,
                "use_layernorm": True,
                "final_norm": "layernorm",
                "normal_channel": False,
            },
        },
    },
    "simple_dp3": {
        "of": _SIMPLE,
        "obs": {"point_cloud": {"shape": [20, 6], "type": "point_cloud"}, "agent_pos": {"shape": [4]}},
        "policy": {
            "down_dims": [16, 24, 24],
            "encoder_output_dim": 16,
            "use_pc_color": True,
            "pointcloud_encoder_cfg": {"in_channels": 6, "out_channels": 16},
        },
    },
    "dp3_add": {
        "of": _DP3,
        "obs": {"point_cloud": {"shape": [20, 3], "type": "point_cloud"}, "agent_pos": {"shape": [4]}},
        "policy": {
            "condition_type": "add",
            "encoder_output_dim": 256,
            "pointcloud_encoder_cfg": {"in_channels": 3, "use_projection": False},
        },
    },
}
LOW = tuple(name for name, made in VARIANTS.items() if "of" not in made)
"""Those of the low-dimensional policy."""
POINTS = tuple(name for name, made in VARIANTS.items() if made.get("of") in (_DP3, _SIMPLE))
"""Those of 3D Diffusion Policy."""


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made = VARIANTS[variant]
    original = "diffusion_policy_3d" if variant in POINTS else _ORIGINAL
    policy = {
        "_target_": f"{original}.policy.{made.get('of', 'diffusion_unet_lowdim_policy.DiffusionUnetLowdimPolicy')}",
        "noise_scheduler": hybrid.scheduler("DDIMScheduler") | {"prediction_type": "sample"}
        if variant in POINTS
        else hybrid.scheduler(made.get("scheduler", "DDPMScheduler")),
        "num_inference_steps": STEPS,
        "horizon": 8,
        "n_action_steps": 4,
        "n_obs_steps": OBSERVED,
        **made["policy"],
    }
    if variant in LOW:
        policy |= {"obs_dim": LOW_DIM, "action_dim": ACTION, "model": _model(made)}
    else:
        policy = {**_TINY, **policy, "shape_meta": {"obs": made["obs"], "action": {"shape": [ACTION]}}}
    if made.get("of") == _IMAGES:
        get_resnet = {"_target_": f"{_ORIGINAL}.model.vision.model_getter.get_resnet", "name": "resnet18"}
        policy["obs_encoder"] = {
            "_target_": f"{_ORIGINAL}.model.vision.multi_image_obs_encoder.MultiImageObsEncoder",
            "shape_meta": policy["shape_meta"],
            **made["encoder"],
            "rgb_model": {**get_resnet, "weights": None, **made["encoder"].get("rgb_model", {})},
        }
    return {"training": {"use_ema": True}, "policy": policy}


def _model(made: dict[str, Any]) -> dict[str, Any]:
    """``cfg.policy.model`` of the low-dimensional policy."""
    as_global, as_local = (made["policy"].get(f"obs_as_{name}_cond", False) for name in ("global", "local"))
    return {
        "_target_": f"{_ORIGINAL}.model.diffusion.conditional_unet1d.ConditionalUnet1D",
        "input_dim": ACTION + (0 if as_global or as_local else LOW_DIM),
        "global_cond_dim": LOW_DIM * OBSERVED if as_global else None,
        "local_cond_dim": LOW_DIM if as_local else None,
        **_TINY,
        **made["model"],
    }


def state_dict(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights as the original saves them, normalisers among them."""
    made, policy = VARIANTS[variant], configuration(variant)["policy"]
    weights = {"_dummy_variable": torch.zeros(0), "mask_generator._dummy_variable": torch.zeros(0)}
    if variant in LOW:
        model = {key: value for key, value in policy["model"].items() if key != "_target_"}
        widths = {"obs": LOW_DIM}
    else:
        as_global = policy.get("obs_as_global_cond", True)
        if variant in POINTS:
            encoder: Any = _points_encoder(policy)
            named = {f"obs_encoder.{name}": value for name, value in encoder.state_dict().items()}
            weights |= hybrid.fill(named, seed)
        elif made["of"] == _HYBRID:
            encoder = hybrid.build_encoder(policy)
            weights |= hybrid.encoder_weights(encoder, seed)
        else:
            encoder = _images_encoder(policy["obs_encoder"])
            weights |= _images_weights(encoder, policy["obs_encoder"], seed)
        model = {"cond_predict_scale": policy.get("cond_predict_scale", True)} | {key: policy[key] for key in _TINY}
        if variant in POINTS:
            model["cond_predict_scale"] = policy.get("condition_type") != "add"
            model |= {"condition_layer": policy.get("condition_type") == "mlp_film"}
            model["blocks"] = 1 if made["of"] == _SIMPLE else 2
        model["input_dim"] = ACTION + (0 if as_global else encoder.width)
        model["global_cond_dim"] = OBSERVED * encoder.width if as_global else None
        widths = {key: 1 if each.get("type") == "rgb" else each["shape"][-1] for key, each in made["obs"].items()}
    network = ConditionalUnet1D(UNetConfig(**model))
    weights |= hybrid.fill({f"model.{key}": value for key, value in network.state_dict().items()}, seed)
    return weights | normalizer(widths | {"action": ACTION})


def _points_encoder(policy: dict[str, Any]) -> PointCloudEncoder:
    cloud, coloured = policy["pointcloud_encoder_cfg"], policy.get("use_pc_color", False)
    norms, last_norm = cloud.get("use_layernorm", False), cloud.get("final_norm") == "layernorm"
    extractor = PointNet(coloured, cloud.get("out_channels"), norms, last_norm)
    return PointCloudEncoder(extractor, 6 if coloured else 3, policy["shape_meta"]["obs"]["agent_pos"]["shape"][0])


def _images_encoder(config: dict[str, Any]) -> MultiImageEncoder:
    """With networks of the right sizes; how images reach them does not matter to the weights."""
    obs = config["shape_meta"]["obs"]
    camera = Camera(8, 8, None, None, (1.0,) * 3, (0.0,) * 3)
    cameras = {key: camera for key, each in sorted(obs.items()) if each.get("type") == "rgb"}
    low_dim = {key: each["shape"][0] for key, each in sorted(obs.items()) if each.get("type") != "rgb"}
    shared = config.get("share_rgb_model", False)
    norm = group_norm if config.get("use_group_norm") and not shared else torch.nn.BatchNorm2d
    return MultiImageEncoder(cameras, low_dim, config["rgb_model"]["name"], norm, shared)


def _images_weights(encoder: MultiImageEncoder, config: dict[str, Any], seed: int) -> dict[str, torch.Tensor]:
    """Under the names of the original."""
    named = {}
    for key, network in zip(encoder.keys, encoder.networks, strict=False):
        owner = "rgb" if config.get("share_rgb_model") else key
        for name, value in network.state_dict().items():
            named[f"obs_encoder.key_model_map.{owner}.{name}"] = value
    return hybrid.fill(named, seed) | {"obs_encoder._dummy_variable": torch.zeros(0)}


def normalizer(widths: dict[str, int]) -> dict[str, torch.Tensor]:
    """Scale and offset of every field, by its width."""
    return {
        f"normalizer.params_dict.{key}.{name}": torch.linspace(low, high, width)
        for key, width in widths.items()
        for name, low, high in (("scale", 0.5, 2.0), ("offset", -0.4, 0.3))
    }


def observation(variant: str) -> dict[str, Array]:
    """What the policy is given, images in 0..1."""
    rng = np.random.RandomState(7)
    keys = VARIANTS[variant].get("obs", {"obs": {"shape": [LOW_DIM]}})
    # 3D Diffusion Policy may be configured with images, which it never looks at.
    shapes = {key: each["shape"] for key, each in keys.items() if variant not in POINTS or key != "image"}
    low = 0.0 if VARIANTS[variant].get("of") in (_HYBRID, _IMAGES) else -1.0
    return {key: rng.uniform(low, 1, (STREAMS, OBSERVED, *shape)).astype(np.float32) for key, shape in shapes.items()}


def noise(sample: tuple[int, int]) -> tuple[Array, Array]:
    """``[B, T, D]`` and ``[K, B, T, D]``."""
    rng = np.random.RandomState(11)
    shape = (STREAMS, *sample)
    return rng.standard_normal(shape).astype(np.float32), rng.standard_normal((STEPS, *shape)).astype(np.float32)


def payload(variant: str) -> dict[str, Any]:
    """A checkpoint before it is saved."""
    states = {"model": state_dict(variant, 1), "ema_model": state_dict(variant)}
    return {"cfg": configuration(variant), "state_dicts": states, "pickles": {}}
