"""LeRobot's ``act``, the Action Chunking Transformer: its network, and its directory to that and ``PolicySpec``.

It is no diffusion policy: one evaluation makes a chunk of images, state and learned queries, and a loop of one step has
nothing to reuse. Normalisers are part of the module, so that the compiled policy takes what the robot measures. The
encoder of a variational autoencoder, with which it is trained, is left out: a robot's latent is zeros. Attribute names
are those under which lerobot saves the weights.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (arXiv 2304.13705), as in
``lerobot.policies.act`` of huggingface/lerobot 0.6, and its processors.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops
from ttscompile.frontends.saved_weights import require_weights
from ttscompile.samplers.table import DirectDenoiser, direct_table

from ..networks.resnet import CHANNELS, DEPTHS, resnet
from .config import ENVIRONMENT, MOST, STATE, LeRobotConfig, read_lerobot_config
from .policy import Measured, policy_spec, read_weights
from .processors import Processors, read_processors

_PROJECTION = "encoder_{}_state_input_proj"


@dataclass(frozen=True)
class ACTConfig:
    """Sizes and variant of the network; the names are those of lerobot's configuration.

    Attributes:
        vectors: what is observed beside images: width of the state of the ``robot``, and of the environment, ``env``.
        vision_backbone: name of the ResNet; None without cameras.
        pre_norm: whether a block's input is normalised, rather than the residual stream after it.
    """

    chunk_size: int
    action_dim: int
    vectors: Mapping[str, int]
    vision_backbone: str | None
    dim_model: int
    n_heads: int
    dim_feedforward: int
    n_encoder_layers: int
    n_decoder_layers: int
    latent_dim: int
    gelu: bool
    pre_norm: bool


class _Layer(nn.Module):
    """Self-attention, in a decoder attention to the encoder's tokens, and feed-forward, each a residual."""

    def __init__(self, config: ACTConfig, decodes: bool) -> None:
        super().__init__()
        width, inner = config.dim_model, config.dim_feedforward
        self.pre_norm, self.activation = config.pre_norm, functional.gelu if config.gelu else torch.relu
        self.self_attn = nn.MultiheadAttention(width, config.n_heads, batch_first=True)
        self.multihead_attn = nn.MultiheadAttention(width, config.n_heads, batch_first=True) if decodes else None
        self.linear1, self.linear2 = nn.Linear(width, inner), nn.Linear(inner, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.norm3 = nn.LayerNorm(width) if decodes else None

    def forward(self, x: Tensor, places: Tensor, *memory: Tensor) -> Tensor:
        """Tokens ``[B, T, width]``, their positions; the encoder's tokens ``[B, S, width]`` with theirs and without."""
        attend, last = partial(self.self_attn, need_weights=False), self.norm2
        x = self._added(x, self.norm1, lambda read: attend(read + places, read + places, read)[0])
        if self.multihead_attn is not None and self.norm3 is not None:
            look, last = partial(self.multihead_attn, need_weights=False), self.norm3
            # What comes before this is the same for all streams: a row that is computed when the policy is compiled.
            places = places.expand(len(memory[0]), -1, -1)
            x = self._added(x, self.norm2, lambda read: look(read + places, *memory)[0])
        return self._added(x, last, lambda read: self.linear2(self.activation(self.linear1(read))))

    def _added(self, x: Tensor, norm: nn.Module, block: Callable[[Tensor], Tensor]) -> Tensor:
        """The residual stream after a block, normalised before the block, or after the addition."""
        return x + block(norm(x)) if self.pre_norm else norm(x + block(x))


class _Layers(nn.Module):
    def __init__(self, config: ACTConfig, count: int, decodes: bool) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(config, decodes) for _ in range(count))
        self.norm = nn.LayerNorm(config.dim_model) if decodes or config.pre_norm else nn.Identity()

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        for layer in self.layers:
            x = layer(x, *others)
        return self.norm(x)  # type: ignore[no-any-return]


class ACT(nn.Module):
    """The network. Its tokens are [latent, vectors, each camera's features, pixel by pixel]."""

    def __init__(self, config: ACTConfig) -> None:
        super().__init__()
        width = config.dim_model
        self.encoder_latent_input_proj = nn.Linear(config.latent_dim, width)
        for name, size in config.vectors.items():
            self.add_module(_PROJECTION.format(name), nn.Linear(size, width))
        self.encoder_1d_feature_pos_embed = nn.Embedding(1 + len(config.vectors), width)
        if config.vision_backbone is not None:
            self.backbone = resnet(3, nn.BatchNorm2d, config.vision_backbone)  # lerobot's is frozen, which is the same
            self.encoder_img_feat_input_proj = nn.Conv2d(CHANNELS, width, 1)
        self.encoder = _Layers(config, config.n_encoder_layers, decodes=False)
        self.decoder = _Layers(config, config.n_decoder_layers, decodes=True)
        self.decoder_pos_embed = nn.Embedding(config.chunk_size, width)
        self.action_head = nn.Linear(width, config.action_dim)

    def forward(self, vectors: Mapping[str, Tensor], images: Sequence[Tensor]) -> Tensor:
        """The chunk ``[B, chunk_size, Da]`` of vectors ``[B, Ds]`` and images ``[B, 3, H, W]``; all are normalised."""
        tokens = [self.get_submodule(_PROJECTION.format(name))(each).unsqueeze(1) for name, each in vectors.items()]
        seen = [self.encoder_img_feat_input_proj(self.backbone(image)) for image in images]
        tokens += [features.flatten(2).transpose(1, 2) for features in seen]
        latent = self.encoder_latent_input_proj.bias.expand(tokens[0].shape[0], 1, -1)  # of zeros
        pixels = [positions_2d(each.shape[2], each.shape[3], each.shape[1]).to(each.device) for each in seen]
        places = torch.cat((self.encoder_1d_feature_pos_embed.weight, *pixels))
        memory = self.encoder(torch.cat((latent, *tokens), dim=1), places)
        queries = self.decoder_pos_embed.weight.unsqueeze(0)
        made = self.decoder(torch.zeros_like(queries), queries, memory + places, memory)
        return self.action_head(made)  # type: ignore[no-any-return]


def positions_2d(height: int, width: int, channels: int) -> Tensor:
    """Sines and cosines of where the pixels of a feature map are, ``[height * width, channels]``.

    Half of the channels are of the row, the others of the column, both counted from 1 and scaled to at most 2 pi.
    """
    half = channels // 2
    frequencies = 10000 ** (2 * (torch.arange(half, dtype=torch.float32) // 2) / half)
    counted = [torch.arange(1, count + 1, dtype=torch.float32) for count in (height, width)]
    scaled = torch.meshgrid(*(each / (each[-1:] + 1e-6) * (2 * math.pi) for each in counted), indexing="ij")
    angles = torch.stack(scaled).flatten(1).unsqueeze(-1) / frequencies
    waves = torch.stack((angles[..., 0::2].sin(), angles[..., 1::2].cos()), dim=-1).flatten(2)
    return torch.cat(tuple(waves), dim=-1)


_MOST_LAYERS = 256
_VECTORS = {STATE: "robot", ENVIRONMENT: "env"}
_COUNTER, _PREFIX = ".num_batches_tracked", "model."
_ONLY_TRAINED = f"{_PREFIX}vae_encoder"
"""Begins the names of what lerobot evaluates in training alone."""


def read_config(directory: Path, entries: Mapping[str, Any]) -> tuple[LeRobotConfig, ACTConfig]:
    """Check ``config.json``, of which these are the entries; defaults are lerobot's."""
    shared = read_lerobot_config(
        directory, entries, horizon=100, n_action_steps=100, environment=True, chunked=True, stateless=True
    )
    settings, widths = shared.settings, {key: shape[0] for key, (_, shape) in shared.features.items()}
    if not shared.cameras and ENVIRONMENT not in widths:
        raise settings.error(f"input_features have neither a camera nor {ENVIRONMENT!r}, of which act needs one")
    if settings.number("n_obs_steps", 1) != 1:
        raise settings.refusal("n_obs_steps", "1, as lerobot has it")
    backbone = str(settings.values.get("vision_backbone", "resnet18"))
    dilated = settings.values.get("replace_final_stride_with_dilation", 0)  # lerobot declares it as a number
    if shared.cameras and (backbone not in DEPTHS or dilated):
        found = f"vision_backbone is {backbone!r:.80}, replace_final_stride_with_dilation {dilated!r:.80}"
        raise CheckpointError(
            f"{settings.where}{found}; expected {' or '.join(DEPTHS)}, and false. Build the network with lerobot and"
            " use ttscompile.compile_denoiser(ttscompile.DirectDenoiser(network), spec)."
        )
    width, heads = settings.number("dim_model", 512, MOST), settings.number("n_heads", 8, MOST)
    if width % heads or (shared.cameras and width % 4):
        raise settings.refusal("dim_model", f"a multiple of n_heads = {heads}, and of 4 with cameras", 512)
    return shared, ACTConfig(
        chunk_size=shared.horizon,
        action_dim=shared.action_dim,
        vectors={name: widths[key] for key, name in _VECTORS.items() if key in widths},
        vision_backbone=backbone if shared.cameras else None,
        dim_model=width,
        n_heads=heads,
        dim_feedforward=settings.number("dim_feedforward", 3200, MOST),
        n_encoder_layers=settings.number("n_encoder_layers", 4, _MOST_LAYERS),
        n_decoder_layers=settings.number("n_decoder_layers", 1, _MOST_LAYERS),
        latent_dim=settings.number("latent_dim", 32, MOST),
        gelu=settings.choice("feedforward_activation", "relu", "gelu") == "gelu",
        pre_norm=settings.flag("pre_norm", False),
    )


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared, config = read_config(directory, entries)
    for name in ("task", "encoders", "without_cameras", "sampler", "steps", "spacing"):
        if getattr(options, name) is not None:
            raise CheckpointError(
                f"{directory}: the option {name} is for other types of policies; this one, act, gives its actions in"
                " one evaluation, is given no instruction and needs all its cameras. Leave it out."
            )
    if shared.settings.values.get("temporal_ensemble_coeff") is not None:
        warnings.warn(
            f"{shared.settings.where}temporal_ensemble_coeff is set, and select_action does no temporal ensembling: it"
            f" takes the first {shared.n_action_steps} of a chunk's actions from a queue. The executor does it, with"
            " ExecutorSettings(seam='ensemble', horizon=1). Otherwise set the coefficient to null, and n_action_steps"
            " to as many as are to be executed.",
            stacklevel=6,
        )
    processors = read_processors(directory, shared.features)
    read = read_weights(shared, options, _COUNTER)
    weights = {name: value for name, value in read.items() if not name.startswith(_ONLY_TRAINED)}
    try:
        # Compared before anything of the configured sizes is made, so that no more memory is taken than the file has.
        with torch.device("meta"):
            expected = as_saved(ACT(config))
        require_weights(expected, weights, "config.json")
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    network = ACT(config)
    for name, value in as_saved(network).items():
        value.copy_(weights[name])
    module = DirectDenoiser(_Observing(shared, processors, network))
    source = {"policy": "act"} | ({"encoder": config.vision_backbone} if config.vision_backbone else {})
    return module.eval(), policy_spec(shared, processors, Loops(direct_table()), source)


def as_saved(network: ACT) -> dict[str, torch.Tensor]:
    """The weights of a network, not copied, under lerobot's names."""
    return {_PREFIX + name: value for name, value in network.state_dict().items() if not name.endswith(_COUNTER)}


class _Observing(Measured):
    """Raw observations to normalised actions: the network, and the normalisers before it."""

    def __init__(self, config: LeRobotConfig, processors: Processors, network: ACT) -> None:
        super().__init__(config, processors, None)
        self.network = network

    def forward(self, **observations: torch.Tensor) -> torch.Tensor:
        """Observations ``[B, 1, ...]`` by name -> ``[B, T, Da]``."""
        measured = self.measured(observations)
        images = [measured.pop(key) for key in self.cameras]
        vectors = {name: measured[key][:, 0] for key, name in _VECTORS.items() if key in measured}
        return self.network(vectors, images)  # type: ignore[no-any-return]
