"""Diffusion Policy's transformer on images: its configuration and weights to an observation encoder.

Source: ``DiffusionTransformerHybridImagePolicy`` of real-stanford/diffusion_policy, which takes its encoder from
robomimic 0.2.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..core.spec import ObservationSpec
from ..errors import CheckpointError
from .diffusion_policy_weights import Weights, affine
from .robomimic_encoder import Camera, ObservationEncoder
from .saved_weights import names_of, require_weights
from .settings import Settings, is_shape
from .transformer_for_diffusion import TransformerConfig

POLICY = "DiffusionTransformerHybridImagePolicy"
ENCODER_KEYS = frozenset({"shape_meta", "crop_shape", "obs_encoder_group_norm", "eval_fixed_crop"})
_NETWORK_DEFAULTS = {
    "n_layer": 8,
    "n_cond_layers": 0,
    "n_head": 4,
    "n_emb": 256,
    "causal_attn": True,
    "time_as_cond": True,
}
NETWORK_KEYS = frozenset({*_NETWORK_DEFAULTS, "p_drop_emb", "p_drop_attn"})
"""Settings of ``cfg.policy`` beside those of the low-dimensional policy."""

_PREFIX = "obs_encoder.obs_nets."
_TWINS = {"nets.0.": "backbone.", "nets.1.": "pool.", "nets.3.": "linear."}
_GRID = ("pool.pos_x", "pool.pos_y")
_ROUNDING = 2**-8  # of numbers up to 1 that were saved as bfloat16; the grid itself is known exactly


@dataclass(frozen=True)
class Observed:
    """What ``shape_meta`` says, checked.

    Attributes:
        action_dim: Da.
        cameras: size of the images of each key that is an image.
        low_dim: shape of each other key.
        order: all keys, as the encoder concatenates their features.
    """

    action_dim: int
    cameras: Mapping[str, tuple[int, int, int]]
    low_dim: Mapping[str, tuple[int, ...]]
    order: tuple[str, ...]


def read_shape_meta(policy: Mapping[str, Any]) -> Observed:
    """``cfg.policy.shape_meta`` as a record.

    Raises:
        CheckpointError: malformed, or observations that the original's encoder does not take either.
    """
    meta = policy.get("shape_meta")
    if not isinstance(meta, dict) or not isinstance(meta.get("obs"), dict) or not isinstance(meta.get("action"), dict):
        raise CheckpointError("cfg.policy.shape_meta is missing or malformed; expected {obs: {...}, action: {shape}}.")
    action = _shape(meta["action"], "action")
    if len(action) != 1:
        raise CheckpointError(f"cfg.policy.shape_meta.action.shape is {list(action)}; expected one number.")
    cameras: dict[str, tuple[int, int, int]] = {}
    low_dim: dict[str, tuple[int, ...]] = {}
    for key, attributes in meta["obs"].items():
        shape = _shape(attributes, f"obs.{key}")
        kind = attributes.get("type", "low_dim")
        if kind not in ("rgb", "low_dim"):
            raise CheckpointError(f"cfg.policy.shape_meta.obs.{key}.type is {kind!r}; expected rgb or low_dim.")
        if kind == "low_dim":
            low_dim[key] = shape
        elif len(shape) == 3:
            cameras[key] = (shape[0], shape[1], shape[2])
        else:
            raise CheckpointError(f"cfg.policy.shape_meta.obs.{key}.shape is {list(shape)}; expected [C, H, W].")
    if not cameras and not low_dim:
        raise CheckpointError("cfg.policy.shape_meta.obs names no observation.")
    return Observed(action[0], cameras, low_dim, tuple(meta["obs"]))


def _shape(attributes: Any, where: str) -> tuple[int, ...]:
    shape = attributes.get("shape") if isinstance(attributes, dict) else None
    if not is_shape(shape):
        raise CheckpointError(f"cfg.policy.shape_meta.{where}.shape is {shape!r}; expected positive whole numbers.")
    return tuple(shape)


def build_encoder(policy: Mapping[str, Any], observed: Observed, weights: Weights) -> ObservationEncoder:
    """The observation encoder with its weights.

    Args:
        policy: ``cfg.policy``.
        observed: of the same.
        weights: of the whole policy; normalisers of images are part of the encoder.

    Raises:
        CheckpointError: settings, weights or normalisers that do not fit.
    """
    settings = Settings(policy, "cfg.policy.")
    group_norm = settings.flag("obs_encoder_group_norm", False)
    fixed = settings.flag("eval_fixed_crop", False)
    crop = settings.size("crop_shape", [76, 76])
    for key, (_, height, width) in observed.cameras.items():
        if crop is not None and (crop[0] >= height or crop[1] >= width):
            raise CheckpointError(
                f"cfg.policy.crop_shape is {list(crop)}, and the images of {key!r} are {height} x {width}; expected a"
                " crop that is smaller; the original refuses this, too."
            )
    if crop is not None and not fixed and observed.cameras:
        warnings.warn(
            "eval_fixed_crop is false: the original crops its images at random even in evaluation. The compiled policy"
            " always takes the centre, as the original does with eval_fixed_crop = true.",
            stacklevel=2,
        )
    cameras = {}
    for key, shape in observed.cameras.items():
        scale, offset = _image_normalizer(weights, key)
        cameras[key] = Camera(shape, crop, scale, offset)
    low_dim = {key: math.prod(shape) for key, shape in observed.low_dim.items()}
    encoder = ObservationEncoder(cameras, low_dim, observed.order, group_norm)
    for key, position in encoder.position.items():
        _load_camera(encoder.cameras[position], weights, key)
    known = tuple(f"{_PREFIX}{key}." for key in cameras)
    extra = [key for key in weights if key.startswith("obs_encoder.") and not key.startswith(known)]
    if extra:
        raise CheckpointError(
            f"the weights hold {names_of(extra)}, which belong to no image of cfg.policy.shape_meta.obs"
            f" ({', '.join(cameras) or 'there are none'}). The policy has another observation encoder; use"
            " ttscompile.compile_denoiser(module, spec)."
        )
    return encoder


def _image_normalizer(weights: Weights, key: str) -> tuple[float, float]:
    """Scale and offset of the images of one key: the original has one number for all channels and places."""
    single = affine(weights, key, None)
    if len(single.scale) != 1:
        raise CheckpointError(
            f"normalizer.params_dict.{key} has {len(single.scale)} entries; expected one for the whole image, as the"
            " original's image normaliser has. Normalise the images before, and fit the policy with the identity."
        )
    return float(single.scale[0]), float(single.offset[0])


def _load_camera(module: torch.nn.Module, weights: Weights, key: str) -> None:
    """Fill the encoder of one camera, whose weights the original saves twice, under both names of one module."""
    prefix = f"{_PREFIX}{key}."
    found: dict[str, torch.Tensor] = {}
    saved: dict[str, str] = {}  # as what each was found first
    for full, value in weights.items():
        if not full.startswith(prefix):
            continue
        name = full.removeprefix(prefix)
        numbered = next((number for number in _TWINS if name.startswith(number)), None)
        if numbered is not None:
            name = _TWINS[numbered] + name.removeprefix(numbered)
        if name in found and not torch.equal(found[name], value):
            raise CheckpointError(
                f"{saved[name]} and {full} differ: both name the same tensor of the original network, which is saved"
                " twice. The checkpoint was changed after it was saved: save it again from the policy."
            )
        found[name] = value
        saved[name] = saved.get(name, full)
    expected = {name: value for name, value in module.state_dict().items() if not name.endswith("num_batches_tracked")}
    require_weights(
        {saved.get(name, prefix + name): value for name, value in expected.items()},
        {saved[name]: value for name, value in found.items()},
        "cfg.policy (shape_meta, crop_shape, obs_encoder_group_norm)",
        what="the weights of the image encoder are not those of robomimic's ResNet-18 with spatial softmax",
    )
    for name in _GRID:
        if not torch.allclose(found[name], expected[name], atol=_ROUNDING):
            raise CheckpointError(f"{saved[name]} is not the grid from -1 to 1 of a spatial softmax; it was changed.")
    module.load_state_dict({name: value for name, value in found.items() if name not in _GRID}, strict=False)


def network_config(policy: Mapping[str, Any], observed: Observed, encoded: int) -> TransformerConfig:
    """The transformer's sizes, which this policy has among its own settings.

    Args:
        policy: ``cfg.policy``, with ``obs_as_cond``.
        observed: of the same.
        encoded: length of what the encoder gives for one step.
    """
    as_cond = policy["obs_as_cond"] is True
    channels = observed.action_dim + (0 if as_cond else encoded)
    values = {name: policy.get(name, default) for name, default in _NETWORK_DEFAULTS.items()}
    values |= {name: policy.get(name) for name in ("horizon", "n_obs_steps")}
    try:
        return TransformerConfig(input_dim=channels, output_dim=channels, cond_dim=encoded if as_cond else 0, **values)
    except CheckpointError as error:
        raise CheckpointError(str(error).replace("cfg.policy.model", "cfg.policy")) from error


def observation_specs(observed: Observed, steps: int, weights: Weights) -> dict[str, ObservationSpec]:
    """What callers give, by key: images in 0..1, normalised by the module; the rest as the normaliser says."""
    specs = {}
    for key in observed.order:
        if key in observed.cameras:
            specs[key] = ObservationSpec((steps, *observed.cameras[key]), bounds=(0.0, 1.0))
        else:
            shape = observed.low_dim[key]
            specs[key] = ObservationSpec((steps, *shape), affine(weights, key, shape[-1]))
    return specs
