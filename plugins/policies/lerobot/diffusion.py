"""LeRobot's ``diffusion``: its directory to module and ``PolicySpec``.

The network is Diffusion Policy's U-Net, and the images of each camera go through a ResNet with a spatial softmax.
Normalisers and image preprocessing are part of the module, so that the compiled policy takes what the robot measures.

Source: ``DiffusionPolicy.predict_action_chunk`` of huggingface/lerobot 0.6, and its processors.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ttscompile.core.spec import PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import require_weights
from ttscompile.frontends.settings import Settings, is_shape

from ..diffusion_policy.hybrid import SpatialSoftmax
from ..networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from ..networks.image_geometry import ResizeCrop
from ..networks.resnet import DEPTHS, SHRINKS, Norm, group_norm, resnet
from .config import ENVIRONMENT, MOST, MOST_PIXELS, STATE, LeRobotConfig, read_lerobot_config
from .policy import Measured, diffusion_loops, policy_spec, read_weights
from .processors import Processors, read_processors

_MOST_LEVELS = 16
_COUNTER = ".num_batches_tracked"
_GRID = ".pos_grid"
_ROUNDING = 2**-8  # of numbers up to 1 that were saved as bfloat16; the grid itself is known exactly


@dataclass(frozen=True)
class DiffusionConfig(LeRobotConfig):
    """What this type has beside what all have.

    Attributes:
        use_group_norm: whether it has group norm in the place of batch norm.
        separate_encoders: whether each camera has an encoder of its own.
        resize: (height, width) of images, or None.
        crop: (height, width) of the centre that is cut out of them, or None.
    """

    network: UNetConfig
    vision_backbone: str
    use_group_norm: bool
    keypoints: int
    separate_encoders: bool
    resize: tuple[int, int] | None
    crop: tuple[int, int] | None

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of what the ResNet sees; of policies with cameras."""
        _, height, width = next(iter(self.cameras.values()))
        return self.crop or self.resize or (height, width)


def read_config(directory: Path, entries: Mapping[str, Any]) -> DiffusionConfig:
    """Check ``config.json``, of which these are the entries; defaults are lerobot's."""
    shared = read_lerobot_config(directory, entries, horizon=64, n_action_steps=32, environment=True)
    settings = shared.settings
    backbone = str(settings.values.get("vision_backbone", "resnet18"))
    if shared.cameras and backbone not in DEPTHS:
        found = f"{settings.where}vision_backbone is {backbone!r:.80}; expected {' or '.join(DEPTHS)}"
        raise CheckpointError(
            f"{found}. Build the network with lerobot and use ttscompile.compile_denoiser(module, spec): the U-Net is"
            " the module, and the features of the encoder are the observation."
        )
    resize, crop = _geometry(settings)
    width = settings.number("spatial_softmax_num_keypoints", 32, MOST)
    environment = shared.features.get(ENVIRONMENT, ("ENV", (0,)))[1][0]
    frame = shared.state_dim + environment + 2 * width * len(shared.cameras)
    return DiffusionConfig(
        **vars(shared),
        network=_network(settings, shared, frame),
        vision_backbone=backbone,
        use_group_norm=settings.flag("use_group_norm", False),
        keypoints=width,
        separate_encoders=settings.flag("use_separate_rgb_encoder_per_camera", True),
        resize=resize,
        crop=crop,
    )


def _geometry(settings: Settings) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """What images are resized to and what is cut out of them; after a resize the crop is a share of it."""
    resize, crop = settings.size("resize_shape", None, MOST_PIXELS), settings.size("crop_shape", None, MOST_PIXELS)
    ratio = settings.values.get("crop_ratio", 1.0)
    if type(ratio) not in (int, float) or not 0 < ratio <= 1:
        raise settings.refusal("crop_ratio", "a number above 0, 1 at most")
    if resize is None:
        return None, crop
    if ratio == 1:
        return resize, None
    height, width = (int(n * ratio) for n in resize)
    if min(height, width) < 1:
        raise settings.refusal("crop_ratio", f"a share that leaves a pixel of {list(resize)}")
    return resize, (height, width)


def _network(settings: Settings, shared: LeRobotConfig, frame: int) -> UNetConfig:
    """Sizes and variant of the denoiser; ``frame`` is the width of what is observed at one step."""
    dims: Any = settings.values.get("down_dims", [512, 1024, 2048])
    if not is_shape(dims, MOST) or len(dims) > _MOST_LEVELS:
        raise settings.refusal("down_dims", f"up to {_MOST_LEVELS} positive whole numbers, {MOST} at most")
    try:
        config = UNetConfig(
            shared.action_dim,
            global_cond_dim=frame * shared.n_obs_steps,
            diffusion_step_embed_dim=settings.number("diffusion_step_embed_dim", 128, MOST),
            down_dims=tuple(dims),
            kernel_size=settings.number("kernel_size", 5, MOST),
            n_groups=settings.number("n_groups", 8, MOST),
            cond_predict_scale=settings.flag("use_film_scale_modulation", True),
        )
    except CheckpointError as error:
        raise CheckpointError(f"{settings.where}{error}") from error
    if shared.horizon % config.divisor:
        expected = f"a multiple of {config.divisor}, because a U-Net of {len(dims)} levels halves it"
        raise settings.refusal("horizon", expected, shared.horizon)
    return config


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    config = read_config(directory, entries)
    for name in ("task", "encoders", "without_cameras"):
        if getattr(options, name) is not None:
            raise CheckpointError(
                f"{directory}: the option {name} is for LeRobot's multi_task_dit and vision-language-action models;"
                " this policy, diffusion, is given no instruction, has no CLIP and needs all its cameras. Leave it out."
            )
    processors = read_processors(directory, config.features)
    weights = read_weights(config, options, _COUNTER)
    try:
        # Compared before anything of the configured sizes is made, so that no more memory is taken than the file has.
        with torch.device("meta"):
            expected = as_saved(Network(config))
        require_weights(expected, weights, "config.json")
        network = Network(config)
        for name, value in as_saved(network).items():
            if not name.endswith(_GRID):
                value.copy_(weights[name])
            elif not torch.allclose(value, weights[name], atol=_ROUNDING):
                raise CheckpointError(f"{name} is not the grid from -1 to 1 of a spatial softmax; it was changed.")
        encoder = ConditionEncoder(config, processors, network.rgb_encoder)
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    module = EncodedDenoiser(encoder, network.unet)
    source = {"policy": "diffusion"} | ({"encoder": config.vision_backbone} if config.cameras else {})
    return module.eval(), policy_spec(config, processors, diffusion_loops(config, options), source)


def as_saved(network: Network) -> dict[str, torch.Tensor]:
    """The weights of a network, not copied, under lerobot's names."""
    own, found = network.state_dict(), {}
    for name, value in own.items():
        saved = re.sub(r"\.blocks\.([01])\.", lambda match: f".conv{int(match[1]) + 1}.", name)
        saved = re.sub(r"(_modules\.\d+\.2)\.conv\.", r"\1.", saved)
        if saved.endswith(".pos_x"):  # lerobot has both axes in one tensor
            saved, value = saved.replace(".pos_x", _GRID), torch.cat((value, own[name.replace(".pos_x", ".pos_y")])).T
        if not saved.endswith((_COUNTER, ".pos_y", ".temperature")):
            found[f"diffusion.{saved}"] = value
    return found


class RgbEncoder(nn.Module):
    """Images to features: ResNet, spatial softmax, linear, ReLU."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        norm: Norm = group_norm if config.use_group_norm else nn.BatchNorm2d
        self.backbone = nn.Sequential(*resnet(3, norm, config.vision_backbone))  # numbered, as lerobot has it
        height, width = (math.ceil(n / SHRINKS) for n in config.image_size)
        self.pool = SpatialSoftmax(height, width, config.keypoints)
        self.out = nn.Linear(2 * config.keypoints, 2 * config.keypoints)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, 3, H, W]`` -> ``[N, 2 keypoints]``."""
        return torch.relu(self.out(self.pool(self.backbone(images))))


class Network(nn.Module):
    """Denoiser and image encoders; of these there is one, a list with one for each camera, or none."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.unet = ConditionalUnet1D(config.network)
        self.rgb_encoder: nn.Module | None = None
        if config.cameras and config.separate_encoders:
            self.rgb_encoder = nn.ModuleList(RgbEncoder(config) for _ in config.cameras)
        elif config.cameras:
            self.rgb_encoder = RgbEncoder(config)


class ConditionEncoder(Measured):
    """Raw observations to the condition vector: each frame is [state, cameras, environment], oldest first."""

    def __init__(self, config: DiffusionConfig, processors: Processors, rgb_encoder: nn.Module | None) -> None:
        geometry = None
        if config.cameras:
            _, height, width = next(iter(config.cameras.values()))
            geometry = ResizeCrop(height, width, config.resize, config.crop)
        super().__init__(config, processors, geometry)
        self.frames, self.rgb_encoder = config.n_obs_steps, rgb_encoder

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Observations ``[B, To, ...]`` by name -> ``[B, C]``."""
        measured = self.measured(observations)
        images = [measured.pop(key) for key in self.cameras]
        parts = [measured.pop(STATE)]
        if isinstance(self.rgb_encoder, nn.ModuleList):
            seen = [encoder(image) for encoder, image in zip(self.rgb_encoder, images, strict=True)]
            parts += [features.reshape(-1, self.frames, features.shape[-1]) for features in seen]
        elif self.rgb_encoder is not None:
            together = self.rgb_encoder(torch.stack(images, dim=1).flatten(0, 1))
            parts.append(together.reshape(-1, self.frames, len(images) * together.shape[-1]))
        return torch.cat((*parts, *measured.values()), dim=-1).flatten(1)
