"""robomimic's observation encoder, rebuilt, and configuration and weights of Diffusion Policy's hybrid policies to it.

For each camera it is a centre crop, ResNet-18, spatial softmax and a linear layer. It is written from the description
of the networks, with attribute names under which the weights of an original checkpoint load; neither torchvision nor
robomimic is needed.

Source: robomimic 0.2 (Mandlekar et al., arXiv 2108.03298), from which ``DiffusionTransformerHybridImagePolicy`` and
``DiffusionUnetHybridImagePolicy`` of real-stanford/diffusion_policy take their encoder; spatial softmax of Finn et al.
(arXiv 1509.06113).
"""

import math
import warnings
from collections import OrderedDict
from collections.abc import Mapping

import numpy as np
import torch
from torch import nn

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import names_of, require_weights
from ttscompile.frontends.settings import Settings

from ..networks.image_geometry import ResizeCrop
from ..networks.resnet import CHANNELS, SHRINKS, Norm, group_norm, resnet
from .parts import Observed, Weights, image_normalizer

KEYPOINTS = 32
FEATURES = 64
"""Width of a camera's features; both as in robomimic's image experiments, which Diffusion Policy takes over."""


class SpatialSoftmax(nn.Module):
    """Expected position, in -1..1, of each learned keypoint under a softmax over a map of ``height x width``."""

    temperature: torch.Tensor
    pos_x: torch.Tensor
    pos_y: torch.Tensor

    def __init__(self, height: int, width: int, keypoints: int = KEYPOINTS) -> None:
        super().__init__()
        self.nets = nn.Conv2d(CHANNELS, keypoints, 1)
        x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
        self.register_buffer("temperature", torch.ones(1))
        self.register_buffer("pos_x", torch.from_numpy(x.reshape(1, -1)).float())
        self.register_buffer("pos_y", torch.from_numpy(y.reshape(1, -1)).float())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """``[N, 512, height, width]`` -> ``[N, 2 keypoints]``: x and y of keypoint 0, of keypoint 1, and so on."""
        attention = (self.nets(features).flatten(2) / self.temperature).softmax(-1)
        positions = torch.cat((self.pos_x, self.pos_y)).T
        return torch.flatten(attention @ positions, 1)


class CameraEncoder(nn.Module):
    """Images of one camera to features: normalise, crop the centre, ResNet-18, spatial softmax, linear, ReLU.

    Args:
        shape: ``(C, H, W)`` of an image as it comes.
        crop: ``(height, width)`` of the centre that is looked at; None for the whole image.
        scale: of the image's normaliser, one number for all of it.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        crop: tuple[int, int] | None,
        norm: Norm,
        scale: float = 1.0,
        offset: float = 0.0,
    ) -> None:
        super().__init__()
        self.scale, self.offset = scale, offset
        channels, height, width = shape
        self.crop = ResizeCrop(height, width, crop=crop)
        height, width = self.crop.size
        numbered = nn.Sequential(*resnet(channels, norm))
        self.backbone = nn.Sequential(OrderedDict(nets=numbered))  # as the checkpoint names them
        self.pool = SpatialSoftmax(math.ceil(height / SHRINKS), math.ceil(width / SHRINKS))
        self.linear = nn.Linear(2 * KEYPOINTS, FEATURES)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, C, H, W]`` -> ``[N, 64]``."""
        x = self.crop(images)
        if (self.scale, self.offset) != (1.0, 0.0):
            x = x * self.scale + self.offset
        return torch.relu(self.linear(self.pool(self.backbone(x))))


class ObservationEncoder(nn.Module):
    """All keys of the observation to one vector for each observed step."""

    def __init__(self, inputs: Mapping[str, CameraEncoder | int]) -> None:
        super().__init__()
        cameras = {key: each for key, each in inputs.items() if isinstance(each, CameraEncoder)}
        self.order = tuple(inputs)
        self.width = sum(FEATURES if isinstance(each, CameraEncoder) else each for each in inputs.values())
        # A list, because a key may be any text and the name of a submodule may not.
        self.cameras = nn.ModuleList(cameras.values())
        self.position = {key: i for i, key in enumerate(cameras)}

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, low-dimensional ones normalised -> ``[B, To, width]``."""
        features = []
        for key in self.order:
            x = observations[key]
            if key in self.position:
                x = self.cameras[self.position[key]](x.flatten(0, 1)).reshape(x.shape[0], x.shape[1], FEATURES)
            features.append(x.flatten(2))
        return torch.cat(features, dim=-1)


ENCODER_KEYS = frozenset({"shape_meta", "crop_shape", "obs_encoder_group_norm", "eval_fixed_crop"})
"""Settings of ``cfg.policy`` that the encoder reads."""

_PREFIX = "obs_encoder.obs_nets."
_TWINS = {"nets.0.": "backbone.", "nets.1.": "pool.", "nets.3.": "linear."}
_GRID = ("pool.pos_x", "pool.pos_y")
_ROUNDING = 2**-8  # of numbers up to 1 that were saved as bfloat16; the grid itself is known exactly


def build_encoder(settings: Settings, observed: Observed, weights: Weights) -> ObservationEncoder:
    """The observation encoder with its weights; normalisers of images are part of it."""
    grouped, fixed = (settings.flag(name, False) for name in ("obs_encoder_group_norm", "eval_fixed_crop"))
    norm: Norm = group_norm if grouped else nn.BatchNorm2d
    crop, inputs = settings.size("crop_shape", [76, 76]), dict[str, CameraEncoder | int]()
    for key, (kind, shape) in observed.items():
        if kind == "low_dim":
            inputs[key] = math.prod(shape)
            continue
        channels, height, width = shape
        if crop is not None and (crop[0] >= height or crop[1] >= width):
            found = f"crop_shape is {list(crop)}, and the images of {key!r} are {height} x {width}"
            raise settings.error(f"{found}; expected a crop that is smaller; the original refuses this, too")
        inputs[key] = CameraEncoder((channels, height, width), crop, norm, *image_normalizer(weights, key))
    encoder = ObservationEncoder(inputs)
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
