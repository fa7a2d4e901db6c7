"""UMI's networks of timm: which one a configuration and weights are of, and how what it gives is pooled.

Source: ``TimmObsEncoder`` and ``TransformerObsEncoder`` of real-stanford/universal_manipulation_interface at d095ba9,
and the networks of timm 0.9.7, which it asks for.
"""

import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from ttscompile.errors import CheckpointError
from ttscompile.frontends.settings import Settings

from ..networks.convnext import convnext
from ..networks.resnet import CHANNELS, DEEPER, WIDER, Norm, group_norm, resnet
from ..networks.timm_vit import DinoConfig, TimmVit, VitConfig
from .images import COLOURS

_VIT = re.compile(
    r"vit_(tiny|small|base|large)_patch\d{1,2}_(clip_(quickgelu_)?\d{2,4}|(reg4_)?dinov2|\d{2,4})(\.\w+)?"
)
_RESNET = re.compile(r"(resnet(?:18|34|50))(\.\w+)?")
_CONVNEXT = re.compile(r"convnext_(tiny|small|base|large|xlarge)(\.\w+)?")
_NAMES = "a plain vision transformer (vit_base_patch16_224), one of CLIP or DINOv2, resnet18, 34 or 50, or a convnext"
_HEAD = 64
"""Width of a head of attention in these transformers."""
_VIT_SHAPE = f"transformer, its heads {_HEAD} wide, its patches square, with a position for each of a square picture"
_PLAIN, _LEARNED = ("avg", "max"), ("soft_attention", "spatial_embedding", "attention_pool_2d", "transformer")


@dataclass(frozen=True)
class Network:
    """One of timm's.

    Attributes:
        make: gives it.
        width: of its features.
        places: of its map, or rows that it gives.
        pooled: width of the maps that the original pools with weights; 0 where a network gives rows.
    """

    make: Callable[[], nn.Module]
    width: int
    places: int
    pooled: int = 0


def model_name(settings: Settings) -> str:
    """Which of timm's networks an encoder has."""
    return settings.text("model_name", "vit_base_patch16_clip_224.openai", 200)


def is_vit(name: str) -> bool:
    """Whether a model is a vision transformer that is rebuilt here, told by its name."""
    return _VIT.fullmatch(name) is not None


def network_of(settings: Settings, weights: Mapping[str, Tensor], size: tuple[int, int], vector: bool) -> Network:
    """The network of a name, of the sizes of its weights.

    Args:
        settings: of the encoder.
        weights: of the first camera's network, as timm calls them.
        size: height and width of its pictures.
        vector: whether all that is observed becomes one vector, or else tokens.
    """
    name, ratio = model_name(settings), settings.number("downsample_ratio", 32)
    if is_vit(name):
        config = _vit_config(settings, name, weights, size)
        asked = settings.values.get("feature_aggregation")
        if asked == "all_tokens" and vector:
            raise settings.refusal("feature_aggregation", "null: the original refuses others that it knows, too")
        whole = asked is None and not vector
        rows = config.grid[0] * config.grid[1] + config.before if whole else 1
        return Network(lambda: TimmVit(config, read=None if whole else 1), config.hidden_size, rows)
    resnets, convnexts = _RESNET.fullmatch(name), _CONVNEXT.fullmatch(name)
    if not (resnets or convnexts):
        raise settings.refusal("model_name", f"{_NAMES}; other networks of timm are not rebuilt here")
    if ratio not in ((32, 16) if resnets else (32,)):
        raise settings.refusal("downsample_ratio", "32, or 16 of a resnet; the original refuses this, too")
    if convnexts:
        channels, depths = _convnext_sizes(weights)
        if min(size) < ratio:
            raise settings.error(f"model_name: {name} takes pictures from {ratio} x {ratio} on; these are {size}")
        return Network(lambda: convnext(channels, depths), channels[-1], math.prod(n // 32 for n in size), 1024)
    assert resnets is not None
    kind, half = resnets[1], ratio == 16
    grouped = settings.flag("use_group_norm", False) and not settings.flag("pretrained", False)
    norm: Norm = group_norm if grouped else nn.BatchNorm2d
    pooled = CHANNELS // 2 if half else CHANNELS

    def made() -> nn.Module:
        return nn.Sequential(*list(resnet(COLOURS, norm, kind))[: 7 if half else 8])

    width = pooled * (WIDER if kind in DEEPER else 1)
    return Network(made, width, math.prod(math.ceil(n / ratio) for n in size), pooled)


def _vit_config(settings: Settings, name: str, weights: Mapping[str, Tensor], size: tuple[int, int]) -> VitConfig:
    patches, places = _shape(weights, "patch_embed.proj.weight", 4), _shape(weights, "pos_embed", 3)[1]
    before = 1 + (_shape(weights, "reg_token", 3)[1] if "reg_token" in weights else 0)
    placed, side = "reg4" not in name, math.isqrt(places)
    width, _, patch, across = patches
    if places != side**2 + before * placed or patch != across or width % _HEAD:
        found = f"{width} wide, with patches of {patch} x {across} pixels and {places} positions"
        raise settings.error(f"model_name is {name!r}, and its weights are {found}; expected a plain {_VIT_SHAPE}")
    if size != (side * patch, side * patch):
        taken = f"takes pictures of {side * patch} x {side * patch}; after its transforms they are"
        raise settings.error(f"model_name: {name} {taken} {size[0]} x {size[1]}. The original refuses this, too")
    clip = "clip" in name
    return (DinoConfig if "dinov2" in name else VitConfig)(
        hidden_size=width,
        intermediate_size=_shape(weights, "blocks.0.mlp.fc1.weight", 2)[0],
        num_hidden_layers=_count(weights, "blocks."),
        num_attention_heads=width // _HEAD,
        hidden_act="quick_gelu" if "quickgelu" in name else "gelu",
        layer_norm_eps=1e-5 if clip else 1e-6,
        grid=(side, side),
        patch_size=patch,
        before=before,
        placed=placed,
        normed=clip,
    )


def _convnext_sizes(weights: Mapping[str, Tensor]) -> tuple[list[int], list[int]]:
    """Channels and blocks of the four stages."""
    stages = [f"1.{i}.blocks." for i in range(4)]
    return [_shape(weights, f"{each}0.gamma", 1)[0] for each in stages], [_count(weights, each) for each in stages]


def _shape(weights: Mapping[str, Tensor], name: str, axes: int) -> tuple[int, ...]:
    """Of a weight of the first camera's network, which has so many axes, none of them empty."""
    value = weights.get(name)
    if value is None or value.ndim != axes or not value.numel():
        found = "none" if value is None else f"one of {tuple(value.shape)}"
        raise CheckpointError(
            f"obs_encoder.key_model_map.*.{name}: expected a weight of {axes} axes; found {found}. What was saved is"
            " another network than cfg.policy.obs_encoder.model_name says, or the file is incomplete."
        )
    return tuple(value.shape)


def _count(weights: Mapping[str, Tensor], prefix: str) -> int:
    return len({name.removeprefix(prefix).split(".")[0] for name in weights if name.startswith(prefix)})


def aggregation(settings: Settings, network: Network, vector: bool) -> str | None:
    """How a map is pooled; None for not at all, as tokens are, and where a transformer gives its rows."""
    if not network.pooled:
        return None
    how = settings.values.get("feature_aggregation", "spatial_embedding" if vector else None)
    allowed: list[str | None] = [*_PLAIN, *_LEARNED] if vector else [None, *_PLAIN, "soft_attention"]
    if network.width != network.pooled:
        allowed = [each for each in allowed if each not in _LEARNED]
    if how not in allowed:
        shown = " or ".join("null" if each is None else each for each in allowed)
        raise settings.refusal("feature_aggregation", f"{shown}: the original refuses others with this network, too")
    if how == "transformer":
        warnings.warn(
            f"{settings.where}feature_aggregation is transformer: the original attends along the batch, so that its"
            " features are the same whatever a camera shows. This policy does not see, and so it is compiled.",
            stacklevel=3,
        )
    return None if how is None else str(how)
