"""UMI's policies at tiny sizes: their checkpoints, with weights that a seed gives, and what they observe.

``tests/families/golden/make_umi.py`` gives the original the same.
"""

import copy
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.families.checks import Arrays, golden, part
from tests.families.weights import draw_weights

SEED, STREAMS, ACTION, HORIZON, COMMITTED = 43, 2, 10, 8, 3
_PACKAGE = "diffusion_policy"
_JITTER = {"_target_": "torchvision.transforms.ColorJitter", "brightness": 0.3, "contrast": 0.4, "saturation": 0.5}
_CROP = [{"type": "RandomCrop", "ratio": 0.9}, _JITTER | {"hue": 0.08}]
_TURN = {"_target_": "torchvision.transforms.RandomRotation", "degrees": [-5.0, 5.0], "expand": False}

SMALL: dict[str, dict[str, Any]] = {
    "vit": {"embed_dim": 128, "depth": 2, "num_heads": 2, "mlp_ratio": 2},
    "convnext": {"depths": (1, 1, 2, 1), "dims": (16, 24, 32, 40)},
    "resnet": {},
}
"""Sizes that timm is asked for in place of its own, by how the name of a network begins."""

_STATES = {"robot0_eef_pos": (3, 2), "robot0_eef_rot_axis_angle": (6, 1), "robot0_gripper_width": (1, 2)}


def _obs(size: int, *cameras: str, frames: int = 2, **more: Any) -> dict[str, Any]:
    """Of pictures and states, each with its number of steps."""
    seen = {key: {"shape": [3, size, size], "horizon": frames, "type": "rgb"} for key in cameras}
    return (
        seen | {key: {"shape": [n], "horizon": steps, "type": "low_dim"} for key, (n, steps) in _STATES.items()} | more
    )


VARIANTS: dict[str, dict[str, Any]] = {
    # As UMI's own configuration has it: CLIP's transformer, and a state that is not looked at.
    "clip": {
        "obs": _obs(48, "camera0_rgb", start={"shape": [6], "horizon": 2, "ignore_by_policy": True}),
        "encoder": {"model_name": "vit_base_patch16_clip_224.openai", "transforms": _CROP},
        "policy": {"inpaint_fixed_action_prefix": True},
    },
    # Two cameras with one network, whose pictures stay as they are, but for their normaliser.
    "plain": {
        "obs": _obs(32, "camera1_rgb", "camera0_rgb", frames=1),
        "encoder": {"model_name": "vit_tiny_patch16_224", "share_rgb_model": True, "transforms": None},
        "images": (2.0, -1.0),
    },
    # DINOv2 of each camera, on pictures that are made smaller.
    "dino": {
        "obs": _obs(40, "camera0_rgb", "camera1_rgb"),
        "encoder": {
            "model_name": "vit_small_patch14_dinov2.lvd142m",
            "transforms": [{"_target_": "torchvision.transforms.Resize", "size": 28, "antialias": True}, _TURN],
        },
    },
    "attention_pool": {
        "obs": _obs(64, "camera0_rgb", "camera1_rgb", frames=1),
        "encoder": {"model_name": "resnet18", "use_group_norm": True, "feature_aggregation": "attention_pool_2d"},
    },
    "spatial_embedding": {
        "obs": _obs(48, "camera0_rgb"),
        "encoder": {"model_name": "resnet34.a1_in1k", "downsample_ratio": 16, "transforms": _CROP},
    },
    "soft_attention": {
        "obs": _obs(64, "camera0_rgb"),
        "encoder": {"model_name": "resnet18", "feature_aggregation": "soft_attention", "pretrained": True},
    },
    "average": {
        "obs": _obs(64, "camera0_rgb"),
        "encoder": {"model_name": "convnext_base.clip_laion2b", "feature_aggregation": "avg"},
    },
    "deeper": {
        "obs": _obs(40, "camera0_rgb"),
        "encoder": {"model_name": "resnet50", "feature_aggregation": "max", "use_group_norm": True},
    },
    "blind": {
        "obs": _obs(64, "camera0_rgb"),
        "encoder": {
            "model_name": "resnet18",
            "feature_aggregation": "transformer",
            "position_encording": "sinusoidal",
            "downsample_ratio": 16,
        },
    },
    # Every token of CLIP's transformer, made narrower; actions attend to them.
    "tokens": {
        "of": "transformer",
        "obs": _obs(64, "camera0_rgb"),
        "encoder": {"model_name": "vit_base_patch16_clip_224.openai", "n_emb": 32, "transforms": [*_CROP[:1], _TURN]},
        "policy": {"n_emb": 32},
    },
    # The class tokens of two cameras, as wide as the transformer.
    "class_tokens": {
        "of": "transformer",
        "obs": _obs(28, "camera0_rgb", "camera1_rgb", frames=1),
        "encoder": {"model_name": "vit_small_patch14_dinov2", "feature_aggregation": "cls", "n_emb": 128},
        "policy": {"n_emb": 128, "n_layer": 1},
    },
    # Every place of a map.
    "places": {
        "of": "transformer",
        "obs": _obs(40, "camera0_rgb", "camera1_rgb", frames=1),
        "encoder": {"model_name": "resnet18", "n_emb": 32, "share_rgb_model": True, "use_group_norm": True},
        "policy": {"n_emb": 32},
    },
}


def configuration(variant: str) -> dict[str, Any]:
    """``cfg`` as it is saved, resolved."""
    made = copy.deepcopy(VARIANTS[variant])
    of = made.get("of", "unet")
    shapes = {"obs": made["obs"], "action": {"shape": [ACTION], "horizon": HORIZON, "rotation_rep": "rotation_6d"}}
    vector = of == "unet"
    names = ("timm_obs_encoder.TimmObsEncoder", "transformer_obs_encoder.TransformerObsEncoder")
    encoder = {
        "_target_": f"{_PACKAGE}.model.vision.{names[of != 'unet']}",
        "shape_meta": shapes,
        "global_pool": "",
        "pretrained": False,
        "frozen": False,
        "transforms": None,
        **({"imagenet_norm": True} if vector else {}),
        **made["encoder"],
    }
    scheduler = {
        "_target_": "diffusers.DDIMScheduler",
        "num_train_timesteps": 50,
        "beta_start": 0.0001,
        "beta_end": 0.02,
        "beta_schedule": "squaredcos_cap_v2",
        "clip_sample": True,
        "clip_sample_range": 4.0,  # wide, so that few actions are where clipping hides what made them
        "set_alpha_to_one": True,
        "steps_offset": 0,
        "prediction_type": "epsilon",
    }
    kinds: dict[str, dict[str, Any]] = {
        "unet": {
            "obs_as_global_cond": True,
            "diffusion_step_embed_dim": 16,
            "down_dims": [16, 24],
            "kernel_size": 5,
            "n_groups": 8,
            "cond_predict_scale": True,
            "train_diffusion_n_samples": 1,
        },
        "transformer": {"n_layer": 2, "n_head": 4, "p_drop_attn": 0.1},
    }
    target = f"{_PACKAGE}.policy.diffusion_{of}_timm_policy.Diffusion{of.capitalize()}TimmPolicy"
    policy = {
        "_target_": target,
        "shape_meta": shapes,
        "noise_scheduler": scheduler,
        "obs_encoder": encoder,
        "num_inference_steps": 16,
        "input_pertub": 0.1,
        **kinds[of],
        **made.get("policy", {}),
    }
    data_set = {"_target_": f"{_PACKAGE}.dataset.umi_dataset.UmiDataset", "dataset_path": "session/dataset.zarr.zip"}
    return {"training": {"use_ema": True}, "policy": policy, "task": {"dataset": data_set}}


def normalizer(variant: str) -> dict[str, torch.Tensor]:
    """Scale and offset of states, pictures and actions."""
    found = dict[str, torch.Tensor]()
    for key, each in ({**VARIANTS[variant]["obs"], "action": {"shape": [ACTION]}}).items():
        scale, offset = torch.linspace(0.5, 2.0, each["shape"][0]), torch.linspace(-0.4, 0.3, each["shape"][0])
        if each.get("type") == "rgb":
            scale, offset = (torch.tensor([n]) for n in VARIANTS[variant].get("images", (1.0, 0.0)))
        found |= {f"normalizer.params_dict.{key}.scale": scale, f"normalizer.params_dict.{key}.offset": offset}
    return found


def draw(shapes: dict[str, Any], cameras: list[str]) -> dict[str, torch.Tensor]:
    """Weights of these names and shapes.

    Convolutions neither grow nor vanish, pictures matter, and the last layer is small, so that few actions are clipped.

    Args:
        cameras: whose networks are one and the same.
    """
    found = draw_weights(shapes, SEED)
    for name, value in found.items():
        if value.ndim == 4:
            value *= np.sqrt(2 / np.prod(value.shape[1:-1]))
        elif name.endswith(("spatial_embedding", "obs_encoder.attention.0.weight")):
            value *= 10 * np.sqrt(value.shape[-1])
        elif name.endswith("running_mean"):
            value -= 1
        elif name.endswith(("final_conv.1.weight", "model.head.weight")):
            value *= 0.2
    for key in cameras:
        twins = {name: name.replace(f"key_model_map.{key}.", f"key_model_map.{cameras[0]}.") for name in found}
        found |= {name: found[twin] for name, twin in twins.items()}
    return found


@cache
def network(variant: str) -> dict[str, torch.Tensor]:
    """The weights, under the names of the original."""
    made = VARIANTS[variant]
    shapes = json.loads(bytes(golden("umi")[f"{variant}.shapes"]))
    cameras = sorted(key for key, each in made["obs"].items() if each.get("type") == "rgb")
    return draw(shapes, cameras if made["encoder"].get("share_rgb_model") else [])


def payload(variant: str, **changes: Any) -> dict[str, Any]:
    """A checkpoint; ``changes`` to ``cfg.policy``, and to its ``obs_encoder``, ``obs`` and ``action`` by these names.

    Args:
        variant: whose.
    """
    config = configuration(variant)
    policy = config["policy"]
    policy["obs_encoder"].update(changes.pop("obs_encoder", {}))
    for name in ("obs", "action"):
        policy["shape_meta"][name].update(changes.pop(name, {}))  # which the encoder has, too
    policy.update(changes)
    states = network(variant) | normalizer(variant) | {"_dummy_variable": torch.zeros(0)}
    return {"cfg": config, "state_dicts": {"model": states, "ema_model": states}, "pickles": {}}


def save(path: Path, variant: str, **changes: Any) -> Path:
    """The same in a file."""
    torch.save(payload(variant, **changes), path)
    return path


def observation(variant: str) -> Arrays:
    """What the policy is given, of every key that it looks at; pictures of 0..1."""
    rng = np.random.default_rng(SEED + 1)
    found = {}
    for key, each in VARIANTS[variant]["obs"].items():
        low = 0.0 if each.get("type") == "rgb" else -1.0
        found[key] = rng.uniform(low, 1, (STREAMS, each["horizon"], *each["shape"])).astype(np.float32)
    return {key: value for key, value in found.items() if key != "start"}


def noise() -> np.ndarray:
    """Which a call begins with, ``[B, T, Da]``."""
    return np.random.default_rng(SEED + 2).standard_normal((STREAMS, HORIZON, ACTION), dtype=np.float32)


def committed() -> np.ndarray:
    """Actions that a call is given, ``[B, N, Da]``."""
    return np.random.default_rng(SEED + 3).uniform(-1, 1, (STREAMS, COMMITTED, ACTION)).astype(np.float32)


def expected(variant: str) -> Arrays:
    """What the original gave."""
    return part(golden("umi"), variant)
