"""Diffusion Policy's encoder of several cameras, rebuilt, and its configuration and weights to that.

It is resize, centre crop, a ResNet and the mean over its map.

Source: ``MultiImageObsEncoder`` and ``get_resnet`` of real-stanford/diffusion_policy (Chi et al., arXiv 2303.04137).
"""

import warnings
from collections.abc import Collection, Mapping

import torch
from torch import nn

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import require_weights
from ttscompile.frontends.settings import Settings

from ..networks.image_geometry import ResizeCrop
from ..networks.resnet import CHANNELS, DEPTHS, Norm, group_norm, resnet
from .parts import MOST_PIXELS, Observed, Weights, image_normalizer

COLOURS = 3
"""Channels of an image, which torchvision's ResNets have."""

Size = tuple[int, int]
Colours = tuple[float, ...]


class Camera(nn.Module):
    """The images of one observation key, as a network sees them.

    Args:
        resize: ``(height, width)`` that they are brought to; None for none.
        crop: of the centre that is looked at; None for the whole image.
        scale: of each colour, after that.
    """

    scale: torch.Tensor
    offset: torch.Tensor

    def __init__(
        self, height: int, width: int, resize: Size | None, crop: Size | None, scale: Colours, offset: Colours
    ) -> None:
        super().__init__()
        # As torchvision 0.13 resizes tensors, which the original's environment has.
        self.geometry = ResizeCrop(height, width, resize, crop, antialias=False)
        for name, values in (("scale", scale), ("offset", offset)):
            self.register_buffer(name, torch.tensor(values).reshape(-1, 1, 1), persistent=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[N, 3, H, W]`` -> ``[N, 3, H', W']``."""
        return self.geometry(images) * self.scale + self.offset  # type: ignore[no-any-return]


class MultiImageEncoder(nn.Module):
    """All keys of the observation to one vector for each observed step: the images' features, then the others."""

    def __init__(
        self, cameras: Mapping[str, Camera], low_dim: Mapping[str, int], network: str, norm: Norm, shared: bool
    ) -> None:
        super().__init__()
        self.keys, self.low_dim = tuple(cameras), tuple(low_dim)
        self.width = CHANNELS * len(cameras) + sum(low_dim.values())
        # Lists, because a key may be any text and the name of a submodule may not.
        self.cameras = nn.ModuleList(cameras.values())
        count = min(len(cameras), 1) if shared else len(cameras)
        self.networks = nn.ModuleList(resnet(COLOURS, norm, network) for _ in range(count))

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, low-dimensional ones normalised -> ``[B, To, width]``."""
        features = []
        for i, (key, camera) in enumerate(zip(self.keys, self.cameras, strict=True)):
            images = observations[key]
            maps = self.networks[min(i, len(self.networks) - 1)](camera(images.flatten(0, 1)))
            features.append(maps.mean((2, 3)).reshape(images.shape[0], images.shape[1], CHANNELS))
        return torch.cat((*features, *(observations[key] for key in self.low_dim)), dim=-1)


_ENCODER = "MultiImageObsEncoder"
_KNOWN = {"_target_", "shape_meta", "rgb_model", "resize_shape", "crop_shape", "random_crop"}
_KNOWN |= {"use_group_norm", "share_rgb_model", "imagenet_norm"}
_PREFIX = "obs_encoder."
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the colours of ImageNet."""


def encoder_settings(settings: Settings, encoder: str = _ENCODER, known: Collection[str] = _KNOWN) -> Settings:
    """``cfg.policy.obs_encoder``, which has to be of this class, and to have no other settings."""
    values = settings.values.get("obs_encoder")
    found = str(values.get("_target_")).rpartition(".")[2] if isinstance(values, dict) else f"{values!r:.80}"
    if found != encoder or not isinstance(values, dict):
        raise CheckpointError(
            f"cfg.policy.obs_encoder is {found}; expected {encoder}. Use ttscompile.compile_denoiser(module, spec) on"
            " a network of your own, its observation encoder inside the module."
        )
    unknown = sorted({*values} - {*known})
    if unknown:
        raise CheckpointError(
            f"cfg.policy.obs_encoder has settings that {encoder} does not know: {', '.join(unknown)}. The encoder was"
            " changed; use ttscompile.compile_denoiser(module, spec)."
        )
    return Settings(values, f"{settings.where}obs_encoder.", settings.remedy)


def build_encoder(settings: Settings, observed: Observed, weights: Weights) -> MultiImageEncoder:
    """The observation encoder with its weights; normalisers of images are part of it."""
    flags = {name: settings.flag(name, False) for name in ("use_group_norm", "share_rgb_model", "imagenet_norm")}
    cameras, low_dim = dict[str, Camera](), dict[str, int]()
    for key, (kind, shape) in sorted(observed.items()):  # the original sorts them, too
        if kind == "rgb":
            cameras[key] = _camera(settings, key, shape, image_normalizer(weights, key), flags["imagenet_norm"])
        elif len(shape) == 1:
            low_dim[key] = shape[0]
        else:
            raise settings.error(f"shape_meta.obs.{key}.shape is {list(shape)}; expected one number")
    shared = flags["share_rgb_model"]
    # The original puts group norm into the networks of single cameras, and leaves the shared one as it is.
    norm: Norm = group_norm if flags["use_group_norm"] and not shared else nn.BatchNorm2d
    arguments = (cameras, low_dim, _network(settings) if cameras else next(iter(DEPTHS)), norm, shared)
    owners = ["rgb"] if shared else list(cameras)

    def saved_name(name: str) -> str:
        _, index, rest = name.split(".", 2)
        return f"{_PREFIX}key_model_map.{owners[int(index)]}.{rest}"

    with torch.device("meta"):  # compared before memory of the configured sizes is taken
        expected = MultiImageEncoder(*arguments).state_dict()
    names = {saved_name(name): name for name in expected if not name.endswith("num_batches_tracked")}
    found = {key: value for key, value in weights.items() if key.startswith(_PREFIX)}
    found.pop(f"{_PREFIX}_dummy_variable", None)
    require_weights(
        {full: expected[name] for full, name in names.items()},
        found,
        "cfg.policy.obs_encoder",
        what=f"the weights of the image encoder are not those of {_ENCODER} with torchvision's ResNets",
    )
    encoder = MultiImageEncoder(*arguments)
    encoder.load_state_dict({name: found[full] for full, name in names.items()}, strict=False)
    return encoder


def _network(settings: Settings) -> str:
    """Name of the ResNet, a key of ``DEPTHS``; which weights it began its training with does not matter."""
    values = settings.values.get("rgb_model")
    model = Settings(values if isinstance(values, dict) else {}, f"{settings.where}rgb_model.", settings.remedy)
    made_by = str(model.values.get("_target_")).rpartition(".")[2]
    if made_by not in ("get_resnet", "get_r3m"):
        raise settings.error(f"rgb_model is made by {made_by}; expected get_resnet with {' or '.join(DEPTHS)}")
    if model.values.get("name") not in tuple(DEPTHS):
        raise model.refusal("name", " or ".join(DEPTHS))
    return str(model.values["name"])


def _camera(
    settings: Settings, key: str, shape: tuple[int, ...], normalizer: tuple[float, float], imagenet: bool
) -> Camera:
    channels, height, width = shape
    if channels != COLOURS:
        raise settings.error(
            f"shape_meta.obs.{key}.shape is {list(shape)}; expected {COLOURS} channels of an RGB image"
        )
    resize, crop = (_size(settings, name, key) for name in ("resize_shape", "crop_shape"))
    whole = resize or (height, width)
    if whole[0] < height or whole[1] < width:
        warnings.warn(
            f"the images of {key!r} are made smaller, {height} x {width} to {whole[0]} x {whole[1]}. That is done as in"
            " the original's environment (torchvision 0.13: bilinear, without antialiasing); from 0.17 on torchvision"
            " does it with antialiasing. If the policy was trained so, resize the images before.",
            stacklevel=2,
        )
    if not settings.flag("random_crop", True):
        crop = None  # the original makes a crop of the centre then, and never uses it
    if crop is not None and (crop[0] >= whole[0] or crop[1] >= whole[1]):
        found = f"crop_shape is {list(crop)}, and the images of {key!r} are {whole[0]} x {whole[1]}"
        raise settings.error(f"{found}; expected a crop that is smaller; the original refuses this, too")
    scale, offset = normalizer
    mean, deviation = (MEAN, DEVIATION) if imagenet else ((0.0,) * COLOURS, (1.0,) * COLOURS)
    scales = tuple(scale / each for each in deviation)
    offsets = tuple((offset - middle) / each for middle, each in zip(mean, deviation, strict=True))
    return Camera(height, width, resize, crop, scales, offsets)


def _size(settings: Settings, name: str, key: str) -> Size | None:
    """One for all cameras, or of each by its key."""
    if not isinstance(settings.values.get(name), dict):
        return settings.size(name, None, MOST_PIXELS)
    return settings.part(name).size(key, [], MOST_PIXELS)
