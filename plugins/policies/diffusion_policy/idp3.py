"""Improved 3D Diffusion Policy, for humanoids: its two observation encoders, rebuilt.

Its checkpoints and its U-Net are those of 3D Diffusion Policy. Points go through a PointNet of several stages; images
through R3M, which is a ResNet. Both are written from the description of the networks.

Source: ``DiffusionPointcloudPolicy`` and ``DiffusionImagePolicy`` of YanjieZe/Improved-3D-Diffusion-Policy at f5b27fa
(Ze et al., arXiv 2410.10803); R3M of Nair et al. (arXiv 2203.12601).
"""

import re
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ttscompile.frontends.saved_weights import require_weights
from ttscompile.frontends.settings import Settings

from ..networks.resnet import CHANNELS, Norm, group_norm, resnet
from .dp3 import (
    MOST_POINTS,
    PLACE,
    PLACES,
    POINTS,
    STATE,
    Extractor,
    PointCloudEncoder,
    conditioned,
    filled,
    on_points,
    require_shapes,
    tell_of_steps,
)
from .images import COLOURS, DEVIATION, MEAN, encoder_settings
from .parts import Observed, Rebuilt, Saved, Weights, image_normalizer, read_shape_meta, require_room
from .timm_pictures import Colours, Pictures, tell_of_draws
from .unet import DEFAULTS, behind_encoder

_STAGES, _WIDTH = 4, 128
"""Of the PointNet, which no setting says."""


class MultiStagePointNet(Extractor):
    """Points to a vector; at each stage a point is told the largest of every feature over all points.

    Args:
        given: points of a cloud.
        wanted: how many are looked at, evenly spaced in the order of those that are given; of fewer all, and one at 0.
        features: of the vector.
    """

    rows: torch.Tensor | None

    def __init__(self, given: int, wanted: int, features: int) -> None:
        super().__init__()
        self.width, self.padded = features, wanted > given
        rows = torch.arange(wanted) * given // wanted if wanted < given else None
        self.register_buffer("rows", rows, persistent=False)
        self.conv_in = nn.Conv1d(PLACE, _WIDTH, 1)
        self.layers = nn.ModuleList(nn.Conv1d(_WIDTH, _WIDTH, 1) for _ in range(_STAGES))
        self.global_layers = nn.ModuleList(nn.Conv1d(2 * _WIDTH, _WIDTH, 1) for _ in range(_STAGES))
        self.conv_out = nn.Conv1d(_STAGES * _WIDTH, features, 1)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """``[N, given, 3]`` -> ``[N, width]``."""
        if self.rows is not None:
            points = points[:, self.rows]
        if self.padded:
            points = nn.functional.pad(points, (0, 0, 0, 1))
        x, stages = torch.relu(self.conv_in(points.transpose(1, 2))), []
        layers: Any = zip(self.layers, self.global_layers, strict=True)
        for own, both in layers:
            x = torch.relu(own(x))
            # One layer on a point beside the largest: of the latter once for all points.
            of_point, of_largest = both.weight.split(_WIDTH, dim=1)
            largest = nn.functional.conv1d(x.amax(-1, keepdim=True), of_largest, both.bias)
            x = torch.relu(nn.functional.conv1d(x, of_point) + largest)
            stages.append(x)
        return self.conv_out(torch.cat(stages, dim=1)).amax(-1)  # type: ignore[no-any-return]


class R3MEncoder(nn.Module):
    """Images and states to a vector: the features of all observed steps, then each key of the state in all of them.

    Args:
        pictures: brings images to what the network looks at.
        states: length by key, in order.
        norm: of the network.
    """

    def __init__(self, pictures: nn.Module, states: Mapping[str, int], norm: Norm) -> None:
        super().__init__()
        self.pictures, self.network, self.states = pictures, resnet(COLOURS, norm), tuple(states)
        self.width = CHANNELS + sum(states.values())

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, states normalised -> ``[B, To, width]``, the vector in To rows."""
        images = observations[_IMAGE]
        features = self.network(self.pictures(images.flatten(0, 1))).mean((2, 3))
        rows = (features.reshape(len(images), -1), *(observations[key].flatten(1) for key in self.states))
        return torch.cat(rows, dim=1).reshape(*images.shape[:2], self.width)


_NAME = "Improved 3D Diffusion Policy"
_AXES = {POINTS: 2, STATE: 1}
"""What the network reads of an observation, and how many axes each has."""
_KNOWN = {*DEFAULTS, *PLACES, "shape_meta", "condition_type", "obs_as_global_cond", "use_pc_color", "pointnet_type"}
_KNOWN |= {"pointcloud_encoder_cfg", "point_downsample", "use_point_crop", "use_image"}
"""Of points; the original makes nothing of the last two."""
_IMAGE = "image"
_ON_IMAGES = {*DEFAULTS, "shape_meta", "condition_type", "obs_as_global_cond", "obs_encoder", "crop_shape"}
_ON_IMAGES |= {"use_depth", "use_depth_only"}
_ENCODER = "TimmObsEncoder"
_OF_ENCODER = {"_target_", "shape_meta", "model_name", "pretrained", "frozen", "global_pool", "transforms"}
_OF_ENCODER |= {"use_group_norm", "share_rgb_model", "imagenet_norm", "feature_aggregation", "downsample_ratio"}
_OF_ENCODER |= {"position_encording"}
_UNUSED_WEIGHTS = re.compile(r"_dummy_variable|spatial_embedding|position_embedding|(attention|aggregation_)\w*\..*")
"""Of an encoder, which R3M makes no use of."""


def points(saved: Saved) -> Rebuilt:
    """``DiffusionPointcloudPolicy``."""
    return on_points(saved, _NAME, _KNOWN, _AXES, _of_points)


def _of_points(settings: Settings, observed: Observed, weights: Weights) -> PointCloudEncoder:
    if settings.values.get("pointnet_type") != "multi_stage_pointnet":
        raise settings.refusal("pointnet_type", "multi_stage_pointnet, the only one that the original has", "pointnet")
    cloud = settings.part("pointcloud_encoder_cfg")
    require_shapes(settings, observed, _AXES, PLACE)
    (given, channels), (state,) = observed[POINTS][1], observed[STATE][1]
    if settings.flag("use_pc_color", False) and channels != PLACE:
        raise settings.error(
            f"use_pc_color is true, and points have {channels} numbers; expected false: the PointNet takes {PLACE}, and"
            " the original cannot run either"
        )
    features, wanted = cloud.number("out_channels"), given
    if settings.flag("point_downsample", False):
        wanted = cloud.number("num_points", most=MOST_POINTS)
    needed = {"pointcloud_encoder_cfg.out_channels": _STAGES * _WIDTH * features, f"shape_meta.obs.{STATE}": state}
    require_room(needed, weights, settings.where)
    if wanted < given:
        warnings.warn(
            f"the original takes {wanted} of {given} points at random, others in every call. Compiled it takes evenly"
            " spaced ones, the same in every call. If points that are near to each other stand together, shuffle them"
            " before.",
            stacklevel=2,
        )
    return filled(PointCloudEncoder(MultiStagePointNet(given, wanted, features), PLACE, state), settings, weights)


def images(saved: Saved) -> Rebuilt:
    """``DiffusionImagePolicy``."""
    network, settings = conditioned(saved, _NAME, _ON_IMAGES), saved.settings
    for name in ("use_depth", "use_depth_only"):
        if settings.flag(name, False):
            raise settings.error(f"{name} is true; expected false: R3M takes colours alone, so the original cannot run")
    action_dim, _ = read_shape_meta(settings, "low_dim", "rgb")
    own = encoder_settings(settings, _ENCODER, _OF_ENCODER)
    if own.values.get("model_name") != "r3m":
        raise own.refusal("model_name", "r3m, the only one that the original has")
    observed = _observed(own, settings.number("n_obs_steps"))
    encoder = _r3m(own, observed, saved.weights)
    rebuilt = behind_encoder(saved, encoder, encoder.width, observed, action_dim, network, _ON_IMAGES)
    tell_of_steps(saved)
    return rebuilt


def _observed(own: Settings, steps: int) -> Observed:
    """What the encoder reads, in its order, each of as many steps as the policy gives."""
    _, every = read_shape_meta(own, "low_dim", "rgb")
    attributes: Any = own.values["shape_meta"]["obs"]
    observed = {key: every[key] for key in sorted(every) if attributes[key].get("ignore_by_policy") is not True}
    if _IMAGE not in observed:
        raise own.error(f"shape_meta.obs has no {_IMAGE}; the original cannot do without it")
    for key, (kind, shape) in observed.items():
        said = attributes[key].get("horizon")
        if said != steps:
            raise own.error(f"shape_meta.obs.{key}.horizon is {said!r:.80}; expected {steps}, as n_obs_steps says")
        if (kind == "rgb") != (key == _IMAGE):
            raise own.error(
                f"shape_meta.obs.{key}.type is {kind}; expected rgb of {_IMAGE} alone, as the original has it"
            )
        if (len(shape) != 1) if kind == "low_dim" else (shape[0] != COLOURS):
            wanted = "one number" if kind == "low_dim" else f"{COLOURS} channels of an RGB image"
            raise own.error(f"shape_meta.obs.{key}.shape is {list(shape)}; expected {wanted}")
    return observed


def _r3m(own: Settings, observed: Observed, weights: Weights) -> R3MEncoder:
    """The encoder of images with its weights; what brings an image to the network is part of it."""
    grouped = own.flag("use_group_norm", False) and not own.flag("pretrained", False)
    norm: Norm = group_norm if grouped else nn.BatchNorm2d
    _, height, width = observed[_IMAGE][1]
    scale, offset = image_normalizer(weights, _IMAGE)  # of 0..255, and what it gives is divided by 255
    pictures = Pictures(own, (height, width), (scale, offset / 255))
    last = Colours([1 / each for each in DEVIATION], [-m / d for m, d in zip(MEAN, DEVIATION, strict=True)])
    states = {key: shape[0] for key, (kind, shape) in observed.items() if kind == "low_dim"}
    encoder = R3MEncoder(nn.Sequential(*pictures.steps, last), states, norm)
    prefix = f"obs_encoder.key_model_map.{_IMAGE}.convnet."
    own_names = (name for name in encoder.state_dict() if not name.endswith("num_batches_tracked"))
    names = {prefix + name.removeprefix("network."): name for name in own_names}
    found = {key: value for key, value in weights.items() if key.startswith("obs_encoder.")}
    found = {key: value for key, value in found.items() if not _UNUSED_WEIGHTS.fullmatch(key.partition(".")[2])}
    expected = encoder.state_dict()
    what = "the weights of the image encoder are not those of R3M's ResNet-18"
    require_weights({full: expected[name] for full, name in names.items()}, found, "cfg.policy.obs_encoder", what=what)
    encoder.load_state_dict({name: found[full] for full, name in names.items()}, strict=False)
    tell_of_draws(own, pictures.drawn)
    return encoder
