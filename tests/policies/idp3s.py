"""Checkpoints of Improved 3D Diffusion Policy with weights that a seed gives, so that golden files stay small.

``golden/make_idp3.py`` gives the original implementations the same weights, observations and noise.
"""

from typing import Any

import numpy as np
import torch

from ttscompile.policies.diffusion_policy.dp3 import PLACE, PointCloudEncoder
from ttscompile.policies.diffusion_policy.idp3 import MultiStagePointNet
from ttscompile.policies.networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from ttscompile.policies.networks.resnet import CHANNELS, group_norm, resnet

from . import hybrid
from .hybrid import Array
from .unets import ACTION, OBSERVED, STEPS, STREAMS, noise, normalizer

__all__ = ["STREAMS", "configuration", "given", "noise", "observation", "payload", "state_dict"]

_PACKAGE = "diffusion_policy_3d"
_TINY = {"diffusion_step_embed_dim": 16, "down_dims": [16, 24], "kernel_size": 3, "n_groups": 4}
_IMAGE = {
    "image": {"shape": [3, 40, 40], "type": "rgb", "horizon": OBSERVED},
    "agent_pos": {"shape": [4], "type": "low_dim", "horizon": OBSERVED},
    "grip": {"shape": [2], "horizon": OBSERVED},
}
_TURN = {"_target_": "torchvision.transforms.RandomRotation", "degrees": [-5.0, 5.0], "expand": False}
_JITTER = {"_target_": "torchvision.transforms.ColorJitter", "brightness": 0.3, "hue": 0.08}

VARIANTS: dict[str, dict[str, Any]] = {
    # As its authors configure it: colours that are not looked at, and as many points as are wanted.
    "points": {"obs": {"point_cloud": {"shape": [20, 6]}, "agent_pos": {"shape": [4]}}, "points": 20},
    # More points than are looked at; a condition with a layer of its own, and not everywhere; DDPM.
    "points_of_more": {
        "obs": {"agent_pos": {"shape": [4]}, "point_cloud": {"shape": [33, 3]}},
        "points": 20,
        "policy": {"condition_type": "mlp_film", "use_mid_condition": False, "use_pc_color": True},
        "scheduler": "DDPMScheduler",
    },
    # Fewer points, beside which the original puts zeros; the noise is predicted.
    "points_of_fewer": {
        "obs": {"point_cloud": {"shape": [12, 6]}, "agent_pos": {"shape": [4]}},
        "points": 20,
        "policy": {"condition_type": "add", "n_action_steps": 7},
        "predicts": "epsilon",
    },
    "images": {
        "obs": _IMAGE,
        "encoder": {"pretrained": True, "transforms": [{"type": "RandomCrop", "ratio": 0.9}, _TURN, _JITTER]},
        "predicts": "epsilon",
    },
    # A ResNet that was not trained before has group norm; nothing is cropped.
    "images_whole": {
        "obs": _IMAGE,
        "encoder": {"pretrained": False, "transforms": None, "feature_aggregation": "spatial_embedding"},
        "policy": {"condition_type": "add"},
    },
}
POINTS = tuple(name for name, made in VARIANTS.items() if "points" in made)


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made = VARIANTS[variant]
    meta = {"obs": made["obs"], "action": {"shape": [ACTION], "horizon": 8}}
    policy = {
        "noise_scheduler": hybrid.scheduler(made.get("scheduler", "DDIMScheduler"))
        | {"prediction_type": made.get("predicts", "sample")},
        "num_inference_steps": STEPS,
        "horizon": 8,
        "n_action_steps": 4,
        "n_obs_steps": OBSERVED,
        "shape_meta": meta,
        **_TINY,
    }
    if variant in POINTS:
        policy |= {
            "_target_": f"{_PACKAGE}.policy.diffusion_pointcloud_policy.DiffusionPointcloudPolicy",
            "use_image": False,
            "use_point_crop": True,
            "pointnet_type": "multi_stage_pointnet",
            "point_downsample": True,
            "pointcloud_encoder_cfg": {"in_channels": 3, "out_channels": 24, "num_points": made["points"]},
        }
    else:
        policy |= {
            "_target_": f"{_PACKAGE}.policy.diffusion_image_policy.DiffusionImagePolicy",
            "obs_encoder": {
                "_target_": f"{_PACKAGE}.model.vision.timm_obs_encoder.TimmObsEncoder",
                "shape_meta": meta,
                "model_name": "r3m",
                "frozen": False,
                "global_pool": "",
                "feature_aggregation": None,
                "use_group_norm": True,
                "imagenet_norm": True,
                **made["encoder"],
            },
        }
    return {"training": {"use_ema": True}, "policy": policy | made.get("policy", {})}


def state_dict(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights as the original saves them, normalisers among them."""
    made, policy = VARIANTS[variant], configuration(variant)["policy"]
    weights = {"_dummy_variable": torch.zeros(0), "mask_generator._dummy_variable": torch.zeros(0)}
    if variant in POINTS:
        encoder = PointCloudEncoder(MultiStagePointNet(1, 1, 24), PLACE, 4)
        weights |= hybrid.fill({f"obs_encoder.{name}": each for name, each in encoder.state_dict().items()}, seed)
        width = encoder.width
    else:
        pretrained = policy["obs_encoder"]["pretrained"]
        network = resnet(3, torch.nn.BatchNorm2d if pretrained else group_norm).state_dict()
        prefix = f"obs_encoder.key_model_map.image.{'module.' * pretrained}convnet."
        weights |= hybrid.fill({prefix + name: each for name, each in network.items()}, seed)
        weights["obs_encoder._dummy_variable"] = torch.zeros(0)
        if policy["obs_encoder"]["feature_aggregation"]:
            weights["obs_encoder.spatial_embedding"] = torch.zeros(1, CHANNELS)
        width = CHANNELS + 6
    condition = policy.get("condition_type", "film")
    model: Any = {"cond_predict_scale": condition != "add", "condition_layer": condition == "mlp_film"} | _TINY
    config = UNetConfig(input_dim=ACTION, global_cond_dim=OBSERVED * width, **model)
    own = ConditionalUnet1D(config).state_dict()
    weights |= hybrid.fill({f"model.{name}": each for name, each in own.items()}, seed)
    # Its data sets normalise actions alone: the others have one number of each for all of them.
    return weights | normalizer(dict.fromkeys(made["obs"], 1) | {"action": ACTION})


def observation(variant: str) -> dict[str, Array]:
    """What the compiled policy is given, images in 0..1."""
    rng = np.random.RandomState(7)
    every = VARIANTS[variant]["obs"].items()
    low = {key: 0.0 if each.get("type") == "rgb" else -1.0 for key, each in every}
    return {
        key: rng.uniform(low[key], 1, (STREAMS, OBSERVED, *each["shape"])).astype(np.float32) for key, each in every
    }


def given(variant: str) -> dict[str, Array]:
    """What the original is given, images in 0..255."""
    return {key: value * 255 if key == "image" else value for key, value in observation(variant).items()}


def payload(variant: str) -> dict[str, Any]:
    """A checkpoint before it is saved."""
    states = {"model": state_dict(variant, 1), "ema_model": state_dict(variant), "optimizer": {"state": {}}}
    return {"cfg": configuration(variant), "state_dicts": states, "pickles": {}}
