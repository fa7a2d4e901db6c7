"""Diffusion Policy's transformer on images: its configuration and weights to an observation encoder.

Source: ``DiffusionTransformerHybridImagePolicy`` of real-stanford/diffusion_policy, which takes its encoder from
robomimic 0.2.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
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
_NETWORK_DEFAULTS = {"n_layer": 8, "n_cond_layers": 0, "n_head": 4, "n_emb": 256}
_NETWORK_DEFAULTS |= {"causal_attn": True, "time_as_cond": True}
NETWORK_KEYS = frozenset({*_NETWORK_DEFAULTS, "p_drop_emb", "p_drop_attn"})
"""Settings of ``cfg.policy`` beside those of the low-dimensional policy."""

_PREFIX = "obs_encoder.obs_nets."
_TWINS = {"nets.0.": "backbone.", "nets.1.": "pool.", "nets.3.": "linear."}
_GRID = ("pool.pos_x", "pool.pos_y")
_ROUNDING = 2**-8  # of numbers up to 1 that were saved as bfloat16; the grid itself is known exactly

Observed = Mapping[str, tuple[str, tuple[int, ...]]]
"""Type (``rgb`` or ``low_dim``) and shape by key, in the order in which the encoder concatenates their features."""


def read_shape_meta(policy: Mapping[str, Any]) -> tuple[int, Observed]:
    """Channels of the action, and the observations, of ``cfg.policy.shape_meta``.

    Raises:
        CheckpointError: malformed, or observations that the original's encoder does not take either.
    """
    meta = policy.get("shape_meta")
    if not isinstance(meta, dict) or not isinstance(meta.get("obs"), dict) or not isinstance(meta.get("action"), dict):
        raise CheckpointError("cfg.policy.shape_meta is missing or malformed; expected {obs: {...}, action: {shape}}.")
    observed = {}
    entries = {"action": meta["action"]} | {f"obs.{key}": each for key, each in meta["obs"].items()}
    for key, attributes in entries.items():
        settings = Settings(attributes if isinstance(attributes, dict) else {}, f"cfg.policy.shape_meta.{key}.")
        shape: Any = settings.values.get("shape")
        if not is_shape(shape):
            raise settings.refusal("shape", "positive whole numbers")
        kind = "low_dim" if key == "action" else settings.choice("type", "low_dim", "rgb")
        if key == "action" and len(shape) != 1:
            raise settings.refusal("shape", "one number")
        if kind == "rgb" and len(shape) != 3:
            raise settings.refusal("shape", "[C, H, W]")
        observed[key] = (kind, tuple(shape))
    _, (action_dim, *_) = observed.pop("action")
    if not observed:
        raise CheckpointError("cfg.policy.shape_meta.obs names no observation.")
    return action_dim, {key.removeprefix("obs."): each for key, each in observed.items()}


def build_encoder(policy: Mapping[str, Any], observed: Observed, weights: Weights) -> ObservationEncoder:
    """The observation encoder with its weights; normalisers of images are part of it.

    Raises:
        CheckpointError: settings, weights or normalisers that do not fit.
    """
    settings = Settings(policy, "cfg.policy.")
    group_norm, fixed = (settings.flag(name, False) for name in ("obs_encoder_group_norm", "eval_fixed_crop"))
    crop = settings.size("crop_shape", [76, 76])
    inputs: dict[str, Camera | int] = {}
    for key, (kind, shape) in observed.items():
        if kind == "low_dim":
            inputs[key] = math.prod(shape)
            continue
        channels, height, width = shape
        if crop is not None and (crop[0] >= height or crop[1] >= width):
            found = f"crop_shape is {list(crop)}, and the images of {key!r} are {height} x {width}"
            raise settings.error(f"{found}; expected a crop that is smaller; the original refuses this, too")
        single = affine(weights, key, None)  # the original has one number for all channels and places
        if len(single.scale) != 1:
            raise CheckpointError(
                f"normalizer.params_dict.{key} has {len(single.scale)} entries; expected one for the whole image."
                " Normalise the images before, and fit the policy with the identity."
            )
        inputs[key] = Camera((channels, height, width), crop, float(single.scale[0]), float(single.offset[0]))
    encoder = ObservationEncoder(inputs, group_norm)
    if crop is not None and not fixed and encoder.position:
        warnings.warn(
            "eval_fixed_crop is false: the original crops its images at random even in evaluation. The compiled policy"
            " always takes the centre, as the original does with eval_fixed_crop = true.",
            stacklevel=2,
        )
    for key, position in encoder.position.items():
        _load_camera(encoder.cameras[position], weights, key)
    known = tuple(f"{_PREFIX}{key}." for key in encoder.position)
    extra = [key for key in weights if key.startswith("obs_encoder.") and not key.startswith(known)]
    if extra:
        raise CheckpointError(
            f"the weights hold {names_of(extra)}, which belong to no image of cfg.policy.shape_meta.obs"
            f" ({', '.join(encoder.position) or 'there are none'}). The policy has another observation encoder; use"
            " ttscompile.compile_denoiser(module, spec)."
        )
    return encoder


def _load_camera(module: torch.nn.Module, weights: Weights, key: str) -> None:
    """Fill the encoder of one camera, whose weights the original saves twice, under both names of one module."""
    prefix = f"{_PREFIX}{key}."
    found: dict[str, torch.Tensor] = {}
    saved: dict[str, str] = {}  # as what each was found first
    for full, value in weights.items():
        if not full.startswith(prefix):
            continue
        name = full.removeprefix(prefix)
        for numbered, twin in _TWINS.items():
            if name.startswith(numbered):
                name = twin + name.removeprefix(numbered)
        if name in found and not torch.equal(found[name], value):
            raise CheckpointError(
                f"{saved[name]} and {full} differ: both name the same tensor of the original network, which is saved"
                " twice. Save the checkpoint again from the policy."
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


def network_config(policy: Mapping[str, Any], action_dim: int, encoded: int) -> TransformerConfig:
    """The transformer's sizes, which this policy has among its own settings; the encoder gives ``encoded`` channels."""
    as_cond = policy["obs_as_cond"] is True
    channels = action_dim + (0 if as_cond else encoded)
    values = {name: policy.get(name, default) for name, default in _NETWORK_DEFAULTS.items()}
    values |= {name: policy.get(name) for name in ("horizon", "n_obs_steps")}
    try:
        return TransformerConfig(input_dim=channels, output_dim=channels, cond_dim=encoded if as_cond else 0, **values)
    except CheckpointError as error:
        raise CheckpointError(str(error).replace("cfg.policy.model", "cfg.policy")) from error


def observation_specs(observed: Observed, steps: int, weights: Weights) -> dict[str, ObservationSpec]:
    """What callers give, by key: images in 0..1, normalised by the module; the rest as the normaliser says."""
    return {
        key: ObservationSpec((steps, *shape), bounds=(0.0, 1.0))
        if kind == "rgb"
        else ObservationSpec((steps, *shape), affine(weights, key, shape[-1]))
        for key, (kind, shape) in observed.items()
    }
