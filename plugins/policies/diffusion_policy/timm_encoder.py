"""UMI's observation encoders with timm's networks, rebuilt; and their configuration and weights to them.

Source: ``TimmObsEncoder`` and ``TransformerObsEncoder`` of real-stanford/universal_manipulation_interface at d095ba9
(Chi et al., arXiv 2402.10329), with the networks of timm 0.9.7, which it asks for.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import nn

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import renamed, require_weights
from ttscompile.frontends.settings import Settings

from ..networks.clip import Attention
from ..networks.timm_vit import own_names
from .images import COLOURS, encoder_settings
from .parts import Weights, affine, image_normalizer, read_shape_meta
from .timm_networks import aggregation, is_vit, model_name, network_of
from .timm_pictures import Pictures, tell_of_draws

_KNOWN = {"_target_", "shape_meta", "model_name", "pretrained", "frozen", "global_pool", "transforms"}
_KNOWN |= {"use_group_norm", "share_rgb_model", "feature_aggregation", "downsample_ratio"}
_OWN: Mapping[str, set[str]] = {
    "TimmObsEncoder": {"imagenet_norm", "position_encording"},  # the first of these is never read by the original
    "TransformerObsEncoder": {"n_emb"},
}
_MOST_FRAMES, _MOST_WIDTH = 4096, 2**16
_PREFIX, _NETWORKS, _PROJECTIONS = "obs_encoder.", "key_model_map.", "key_projection_map."
_POOL = (
    (r"^attention_pool_2d\.c_", "attention_pool_2d.out_"),
    (r"^attention_pool_2d\.(\w+_p)", r"attention_pool_2d.attend.\1"),
)

_HEAD = 64
"""Width of a head of attention, where a map is pooled."""
_VECTOR = "TimmObsEncoder"
"""The encoder that gives one vector; the other one gives tokens."""


class _AttentionPool(nn.Module):
    """The mean of a map's places, with a position as they have, looks at all of them: ``[N, places, C]`` to 1 row."""

    def __init__(self, places: int, width: int) -> None:
        super().__init__()
        self.positional_embedding = nn.Parameter(torch.zeros(places + 1, width))
        self.attend = Attention(width, width // _HEAD)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        seen = torch.cat((x.mean(1, keepdim=True), x), 1) + self.positional_embedding
        return self.attend(seen[:, :1], seen, None)  # type: ignore[no-any-return]


class Aggregation(nn.Module):
    """A map ``[N, C, h, w]`` to one row ``[N, 1, C]``, or to a row for each place, ``[N, h * w, C]``.

    Args:
        how: as ``feature_aggregation`` has it; None for a row for each place.
        sinusoidal: whether positions of ``transformer`` are waves, which no checkpoint holds.
    """

    def __init__(self, how: str | None, places: int, width: int, sinusoidal: bool = False) -> None:
        super().__init__()
        self.how = how
        if how == "soft_attention":
            self.attention = nn.Sequential(nn.Linear(width, 1, bias=False))
        elif how == "spatial_embedding":
            self.spatial_embedding = nn.Parameter(torch.zeros(places, width))
        elif how == "attention_pool_2d":
            self.attention_pool_2d = _AttentionPool(places, width)
        elif how == "transformer":
            self.position_embedding = nn.Parameter(torch.zeros(places + 1, width))
            if sinusoidal:  # of the place that is read: sines are 0, cosines 1
                del self.position_embedding
                first = torch.arange(width, dtype=torch.float32, device="cpu")[None] % 2
                self.register_buffer("position_embedding", first, persistent=False)
            layers = (nn.TransformerEncoderLayer(width, 4, dropout=0.0) for _ in range(4))
            self.aggregation_transformer = nn.ModuleDict({"layers": nn.Sequential(*layers)})

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """See the class."""
        x = maps.flatten(2).transpose(1, 2)
        match self.how:
            case "avg":
                return x.mean(1, keepdim=True)
            case "max":
                return x.amax(1, keepdim=True)
            case "soft_attention":
                return (x * self.attention(x).softmax(1)).sum(1, keepdim=True)  # type: ignore[no-any-return]
            case "spatial_embedding":
                return (x * self.spatial_embedding).mean(1, keepdim=True)
            case "attention_pool_2d":
                return self.attention_pool_2d(x)  # type: ignore[no-any-return]
            case "transformer":
                # The original attends along the batch, and takes the row that holds no place: alike in all pictures.
                row: torch.Tensor = self.aggregation_transformer["layers"](self.position_embedding[None, :1])
                return row.expand(len(x), -1, -1)
        return x


class TimmEncoder(nn.Module):
    """All keys of the observation to features: cameras in the order of their names, then the others in theirs.

    Args:
        keys: of the observation, in this order.
        pictures: what is done to the pictures of each camera.
        networks: of each camera, or one for all of them.
        pool: of what a network gives.
        projections: of what each key gives, to tokens of one width; none where all is one vector.
    """

    def __init__(
        self,
        keys: Sequence[str],
        pictures: Sequence[nn.Module],
        networks: Sequence[nn.Module],
        pool: nn.Module,
        projections: Sequence[nn.Module],
    ) -> None:
        super().__init__()
        self.keys = tuple(keys)
        # Lists, because a key may be any text and the name of a submodule may not.
        self.pictures, self.networks = nn.ModuleList(pictures), nn.ModuleList(networks)
        self.pool, self.projections = pool, nn.ModuleList(projections)

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """By key ``[B, To, ...]``, states normalised -> ``[B, width]``, or with projections ``[B, tokens, width]``."""
        features = [observations[key] for key in self.keys]
        for i, picture in enumerate(self.pictures):
            images = features[i]
            seen = self.pool(self.networks[min(i, len(self.networks) - 1)](picture(images.flatten(0, 1))))
            features[i] = seen.reshape(images.shape[0], -1, seen.shape[-1])
        if not self.projections:
            return torch.cat([each.flatten(1) for each in features], -1)
        projected = (project(each) for project, each in zip(self.projections, features, strict=True))
        return torch.cat(list(projected), 1)


@dataclass(frozen=True)
class Encoder:
    """What is rebuilt of an observation encoder.

    Attributes:
        module: ``TimmEncoder`` with its weights.
        observations: what callers give, by key.
        rows: tokens of an observation; 1 where all is one vector.
        width: of each.
    """

    module: TimmEncoder
    observations: dict[str, ObservationSpec]
    rows: int
    width: int


def build(policy: Settings, name: str, weights: Weights) -> Encoder:
    """The observation encoder of ``cfg.policy`` with its weights; normalisers of images are part of it.

    Args:
        policy: its settings.
        name: of the encoder's class: ``TimmObsEncoder``, one vector, or ``TransformerObsEncoder``, tokens.
        weights: of the policy.
    """
    settings = encoder_settings(policy, name, _KNOWN | _OWN[name])
    settings.choice("global_pool", "")
    observed = _observed(settings, some=name == _VECTOR)
    cameras = sorted(key for key, shape in observed.items() if len(shape) > 2)
    keys = [*cameras, *sorted(observed.keys() - cameras)]
    if not cameras or len({observed[key][1:] for key in cameras}) > 1:
        sizes = {key: list(observed[key][1:]) for key in cameras}
        raise settings.error(f"shape_meta.obs: expected cameras (type: rgb) of one size; found {sizes}")
    size = observed[cameras[0]][2:]
    pictures = [Pictures(settings, (size[0], size[1]), image_normalizer(weights, key)) for key in cameras]
    tell_of_draws(settings, [each for one in pictures for each in one.drawn])
    shared = settings.flag("share_rgb_model", False)
    found = _renamed(weights, keys, cameras[:1] if shared else cameras, shared)
    own = {key.removeprefix("networks.0."): each for key, each in found.items() if key.startswith("networks.0.")}
    network = network_of(settings, own, pictures[0].size, name == _VECTOR)
    how = aggregation(settings, network, name == _VECTOR)
    waves = settings.choice("position_encording", "learnable", "sinusoidal") == "sinusoidal"
    wanted = settings.number("n_emb", 768, _MOST_WIDTH) if name != _VECTOR else None
    rows = [observed[key][0] * (1 if how or key not in cameras else max(1, network.places)) for key in keys]
    widths = [network.width if key in cameras else observed[key][1] for key in keys]
    steps = [nn.Sequential(*each.steps) for each in pictures]

    def made() -> TimmEncoder:
        networks = [network.make() for _ in range(1 if shared else len(cameras))]
        pool = Aggregation(how, network.places, network.width, waves) if network.pooled else nn.Identity()
        projections = [nn.Linear(n, wanted) if n != wanted else nn.Identity() for n in widths] if wanted else []
        return TimmEncoder(keys, steps, networks, pool, projections)

    module = _filled(made, own_names(found) if is_vit(model_name(settings)) else found)
    specs = {
        key: ObservationSpec(shape, bounds=(0.0, 1.0))
        if key in cameras
        else ObservationSpec(shape, affine(weights, key, shape[-1]))
        for key, shape in observed.items()
    }
    vector = sum(count * width for count, width in zip(rows, widths, strict=True))
    return Encoder(module, specs, sum(rows) if wanted else 1, wanted or vector)


def _observed(settings: Settings, some: bool) -> dict[str, tuple[int, ...]]:
    """``(steps, *shape)`` of what is looked at, by key.

    Args:
        some: whether low-dimensional observations may be left out, as one of the two encoders does.
    """
    found = {}
    for key, (kind, shape) in read_shape_meta(settings, "low_dim", "rgb")[1].items():
        own = settings.part("shape_meta").part("obs").part(key)
        if kind == "low_dim" and some and own.flag("ignore_by_policy", False):
            continue
        if len(shape) != 1 and (kind != "rgb" or shape[0] != COLOURS):
            raise own.refusal("shape", f"one number, or of a picture [{COLOURS}, H, W]")
        found[key] = (own.number("horizon", most=_MOST_FRAMES), *shape)
    return found


def _renamed(weights: Weights, keys: Sequence[str], cameras: Sequence[str], shared: bool) -> dict[str, torch.Tensor]:
    """The encoder's weights, as ``TimmEncoder`` calls all but those within its networks.

    Args:
        keys: of the observation, in the order of the projections.
        cameras: whose networks are looked at: those of the others are the same, and have to be.
    """
    found = dict[str, torch.Tensor]()
    places = {f"{_NETWORKS}{key}.": f"networks.{i}." for i, key in enumerate(cameras)}
    places |= {f"{_PROJECTIONS}{key}.": f"projections.{i}." for i, key in enumerate(keys)}
    for full, value in weights.items():
        name = full.removeprefix(_PREFIX)
        if not full.startswith(_PREFIX) or name == "_dummy_variable":
            continue
        place = next((place for place in places if name.startswith(place)), None)
        copy = next((key for key in keys if shared and place is None and name.startswith(f"{_NETWORKS}{key}.")), None)
        if copy is not None:
            twin = name.replace(f"{_NETWORKS}{copy}.", f"{_PREFIX}{_NETWORKS}{cameras[0]}.", 1)
            if twin not in weights or not torch.equal(weights[twin], value):
                raise CheckpointError(f"{full} is not {twin}, though share_rgb_model is true: save the policy again.")
        elif place is not None:
            found[places[place] + name.removeprefix(place)] = value
        else:
            found["pool." + renamed(name, _POOL)] = value
    return found


def _filled(make: Callable[[], TimmEncoder], found: Mapping[str, torch.Tensor]) -> TimmEncoder:
    """The module with these weights, which are compared before memory of the configured sizes is taken."""
    with torch.device("meta"):
        expected = make().state_dict()
    counters = {name: torch.zeros((), dtype=torch.int64) for name in expected if name.endswith("num_batches_tracked")}
    require_weights({k: v for k, v in expected.items() if k not in counters}, found, f"cfg.policy.{_PREFIX[:-1]}")
    module = make()
    module.load_state_dict({**found, **counters}, assign=True)
    return module
