"""Diffusion Policy's hybrid policies, on images with robomimic's encoder: configuration and weights to that encoder.

Source: ``DiffusionTransformerHybridImagePolicy`` and ``DiffusionUnetHybridImagePolicy`` of
real-stanford/diffusion_policy, which take their encoder from robomimic 0.2.
"""

from __future__ import annotations

import math
import warnings

import torch

from ..errors import CheckpointError
from .diffusion_policy_parts import Observed, image_normalizer
from .diffusion_policy_weights import Weights
from .robomimic_encoder import Camera, ObservationEncoder
from .saved_weights import names_of, require_weights
from .settings import Settings

ENCODER_KEYS = frozenset({"shape_meta", "crop_shape", "obs_encoder_group_norm", "eval_fixed_crop"})
"""Settings of ``cfg.policy`` that the encoder reads."""

_PREFIX = "obs_encoder.obs_nets."
_TWINS = {"nets.0.": "backbone.", "nets.1.": "pool.", "nets.3.": "linear."}
_GRID = ("pool.pos_x", "pool.pos_y")
_ROUNDING = 2**-8  # of numbers up to 1 that were saved as bfloat16; the grid itself is known exactly


def build_encoder(settings: Settings, observed: Observed, weights: Weights) -> ObservationEncoder:
    """The observation encoder with its weights; normalisers of images are part of it."""
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
        inputs[key] = Camera((channels, height, width), crop, *image_normalizer(weights, key))
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
