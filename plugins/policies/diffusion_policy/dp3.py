"""3D Diffusion Policy: its observation encoder, rebuilt, and configuration and weights to that and a U-Net.

Its checkpoints have the form of Diffusion Policy's, and its networks are the U-Net of that with other conditions. The
encoder, a small PointNet and an MLP for the robot's state, is written from the description of the networks, with
attribute names under which the weights of an original checkpoint load.

Source: ``DP3`` and ``SimpleDP3`` of YanjieZe/3D-Diffusion-Policy (Ze et al., arXiv 2403.03954); PointNet of Qi et al.
(arXiv 1612.00593).
"""

import warnings
from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from torch import nn

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import require_weights
from ttscompile.frontends.settings import Settings

from .parts import COMMON_KEYS, Observed, Rebuilt, Saved, Weights, affine, read_shape_meta, require_room
from .unet import DEFAULTS, behind_encoder

POINTS, STATE, ROBOT = "point_cloud", "agent_pos", "imagin_robot"
"""Keys of the observation: the points seen, the robot's state, and points of the robot that are added to those seen."""
PLACE, COLOURED = 3, 6
"""Channels of a point: where it is, and its colour."""

_STATE_WIDTH = 64
_WIDTHS = (64, 128, 256)
_COLOURED_WIDTHS = (*_WIDTHS, 512)


class Extractor(nn.Module):
    """Points ``[N, points, channels]`` to a vector ``[N, width]``."""

    width: int


class PointNet(Extractor):
    """Points to a vector: an MLP of each point, the largest of each feature over all points, and a linear layer.

    Args:
        coloured: whether points have a colour; the MLP is a layer deeper then, which has no norm.
        features: of the vector; None for those of the MLP, without a layer after it.
        norms: whether the MLP has layer norms.
    """

    def __init__(self, coloured: bool, features: int | None, norms: bool, last_norm: bool) -> None:
        super().__init__()
        widths = _COLOURED_WIDTHS if coloured else _WIDTHS
        layers: list[nn.Module] = []
        before = COLOURED if coloured else PLACE
        for width in widths:
            layers += [nn.Linear(before, width), nn.LayerNorm(width) if norms else nn.Identity(), nn.ReLU()]
            before = width
        self.mlp = nn.Sequential(*(layers[:-2] if coloured else layers))
        self.final_projection: nn.Module = nn.Identity()
        self.width = features or before
        if features is not None:
            linear = nn.Linear(before, features)
            self.final_projection = nn.Sequential(linear, nn.LayerNorm(features)) if last_norm else linear

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """``[N, points, channels]`` -> ``[N, width]``."""
        return self.final_projection(self.mlp(points).amax(1))  # type: ignore[no-any-return]


class PointCloudEncoder(nn.Module):
    """Points and the robot's state to one vector for each observed step."""

    def __init__(self, extractor: Extractor, channels: int, state: int) -> None:
        super().__init__()
        self.extractor, self.channels = extractor, channels
        self.state_mlp = nn.Sequential(nn.Linear(state, _STATE_WIDTH), nn.ReLU(), nn.Linear(_STATE_WIDTH, _STATE_WIDTH))
        self.width = extractor.width + _STATE_WIDTH

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, normalised -> ``[B, To, width]``."""
        clouds = [observations[key][..., : self.channels] for key in (POINTS, ROBOT) if key in observations]
        points = torch.cat(clouds, dim=2)
        features = self.extractor(points.flatten(0, 1)).reshape(*points.shape[:2], self.extractor.width)
        return torch.cat((features, self.state_mlp(observations[STATE])), dim=-1)


_NAME = "3D Diffusion Policy"
_CHANGED = "The policy was changed; use ttscompile.compile_denoiser(module, spec)."
_PREFIX = "obs_encoder."
_CONDITIONS = {
    "film": {"cond_predict_scale": True},
    "add": {"cond_predict_scale": False},
    "mlp_film": {"cond_predict_scale": True, "condition_layer": True},
}
_AXES = {POINTS: 2, STATE: 1, ROBOT: 2}
"""What the network reads of an observation, and how many axes each has."""
MOST_POINTS = 2**16
"""Of a cloud, which the weights do not limit; in use are 512 to 4096."""
PLACES = ("use_down_condition", "use_mid_condition", "use_up_condition")
_ENCODER_KEYS = {"shape_meta", "encoder_output_dim", "use_pc_color", "pointnet_type", "pointcloud_encoder_cfg"}
_UNUSED = {"crop_shape", "use_point_crop"}  # of the policy: one has no image, the other is for its environments
_KNOWN = {*DEFAULTS, *PLACES, *_ENCODER_KEYS, *_UNUSED, "condition_type", "obs_as_global_cond"}


def full(saved: Saved) -> Rebuilt:
    """``DP3``."""
    return on_points(saved, _NAME, _KNOWN, _AXES, _encoder)


def simple(saved: Saved) -> Rebuilt:
    """``SimpleDP3``, whose U-Net has half as many blocks."""
    return on_points(saved, _NAME, _KNOWN, _AXES, _encoder, blocks=1)


def on_points(
    saved: Saved,
    name: str,
    known: Collection[str],
    axes: Mapping[str, int],
    encoder: Callable[[Settings, Observed, Weights], PointCloudEncoder],
    blocks: int = 2,
) -> Rebuilt:
    """A U-Net behind an encoder of points.

    Args:
        saved: the policy.
        name: of its project, for messages.
        known: settings of ``cfg.policy`` that its class has, beside those that all have.
        axes: what its encoder reads of an observation, and how many axes each has.
        encoder: makes that, with its weights, of the settings and of what is observed.
        blocks: of a level of the U-Net.
    """
    network = conditioned(saved, name, known) | {"blocks": blocks}
    action_dim, every = read_shape_meta(
        saved.settings
    )  # the original looks at no type, and some of its tasks say low_dimx
    observed = {key: _as_given(key, *each, saved.weights) for key, each in every.items() if key in axes}
    made = encoder(saved.settings, observed, saved.weights)
    rebuilt = behind_encoder(saved, made, made.width, observed, action_dim, network, known)
    tell_of_steps(saved)
    return rebuilt


def conditioned(saved: Saved, name: str, known: Collection[str]) -> dict[str, Any]:
    """Settings of the U-Net, but for its channels; whatever in ``cfg.policy`` is not known is refused."""
    settings = saved.settings
    unknown = sorted(set(saved.policy) - set(known) - COMMON_KEYS)
    if unknown:
        raise CheckpointError(f"cfg.policy has settings that {name} does not know: {', '.join(unknown)}. {_CHANGED}")
    if not settings.flag("obs_as_global_cond", True):
        raise settings.error("obs_as_global_cond is false; expected true, without which the original cannot run either")
    condition = settings.values.get("condition_type", "film")
    if condition not in tuple(_CONDITIONS):
        raise settings.error(
            f"condition_type is {condition!r:.80}; expected {' or '.join(_CONDITIONS)}. The original's networks with"
            " cross_attention_* cannot run: they put a timestep without an axis of observed steps beside observations"
            " with one"
        )
    network: dict[str, Any] = {key: saved.policy.get(key, default) for key, default in DEFAULTS.items()}
    return network | _CONDITIONS[condition] | {"conditioned": tuple(settings.flag(key, True) for key in PLACES)}


def tell_of_steps(saved: Saved) -> None:
    """Warn where the steps are others than in the original's environment."""
    scheduler = saved.policy["noise_scheduler"]
    if scheduler.get("prediction_type") == "sample" and str(scheduler.get("_target_")).endswith("DDIMScheduler"):
        warnings.warn(
            "DDIM's steps are those of diffusers from 0.15 on. Up to 0.14, and the original asks for 0.11.1, it took a"
            " predicted sample for noise, which gives other actions. Evaluate the compiled policy, or compare it with"
            " the original under a later diffusers.",
            stacklevel=2,
        )


def _as_given(key: str, kind: str, shape: tuple[int, ...], weights: Weights) -> tuple[str, tuple[int, ...]]:
    """Type and shape of an observation as it comes.

    The original normalises whole points, and then takes the channels that its network reads. Its tasks say the shape of
    those alone, [512, 3], where the points of their data sets, and of their normalisers, have colours as well.
    """
    channels = len(affine(weights, key, None).scale) if len(shape) == 2 else 1
    return kind, (shape[0], channels) if channels > 1 else shape


def _encoder(settings: Settings, observed: Observed, weights: Weights) -> PointCloudEncoder:
    coloured = settings.flag("use_pc_color", False)
    settings.choice("pointnet_type", "pointnet")
    cloud = settings.part("pointcloud_encoder_cfg")
    channels = COLOURED if coloured else PLACE
    require_shapes(settings, observed, _AXES, channels)
    # Only the PointNet without colours can do without the last layer.
    projected = cloud.flag("use_projection", True) or coloured
    features = cloud.number("out_channels", 1024) if projected else None
    last_norm = cloud.choice("final_norm", "none", "layernorm") == "layernorm"
    state = observed[STATE][1][0]
    require_room({"out_channels": features or 0, f"shape_meta.obs.{STATE}": state}, weights, settings.where)
    extractor = PointNet(coloured, features, cloud.flag("use_layernorm", False), last_norm)
    if settings.number("encoder_output_dim", 256) != extractor.width:
        found = f"encoder_output_dim is {settings.values.get('encoder_output_dim', 256)}"
        raise settings.error(f"{found}; expected {extractor.width}, which its PointNet gives")
    return filled(PointCloudEncoder(extractor, channels, state), settings, weights)


def require_shapes(settings: Settings, observed: Observed, axes: Mapping[str, int], channels: int) -> None:
    """Raise unless all that an encoder of points reads is there, but for points of the robot, and of its shape."""
    for key, count in axes.items():
        if key == ROBOT and key not in observed:
            continue
        shape = observed[key][1] if key in observed else ()
        if len(shape) != count or (count == 2 and (shape[1] < channels or max(shape) > MOST_POINTS)):
            found = f"{list(shape)}" if key in observed else "missing"
            wanted = f"[points, {channels}], {MOST_POINTS} points at most" if count == 2 else "[length]"
            raise settings.error(f"shape_meta.obs.{key} is {found}; expected the shape {wanted}")


def filled(encoder: PointCloudEncoder, settings: Settings, weights: Weights) -> PointCloudEncoder:
    """An encoder of points with its weights."""
    found_weights = {key: value for key, value in weights.items() if key.startswith(_PREFIX)}
    require_weights(
        {_PREFIX + name: value for name, value in encoder.state_dict().items()},
        found_weights,
        f"{settings.where}pointcloud_encoder_cfg",
    )
    encoder.load_state_dict({key.removeprefix(_PREFIX): value for key, value in found_weights.items()})
    return encoder
