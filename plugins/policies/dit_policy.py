"""DiT-Policy: an encoder over observation tokens, and a decoder whose layer i is modulated by mean(encoder i) + time.

Parameters are called as in the original, ``data4robotics/models/diffusion.py`` of SudeepDasari/dit-policy (arXiv
2410.10088). Everything is sequence first, ``[T, B, E]``; scales are not added to 1, and the encoder is post-norm. It is
a condition: it leaves the loop.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import Affine, ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.scheduler import MOST_TIMESTEPS
from ttscompile.frontends.settings import Settings, read_json

from .loops import ddim_loops
from .networks.dit_policy_tokens import CAMERA, PIXELS, STATE, Observed, Tokens, TokensConfig
from .networks.layers import ModulatedFinal
from .networks.resnet import DEPTHS
from .yaml_files import read_yaml

AGENT, NORMS = "agent_config.yaml", "ac_norm.json"
"""Beside the checkpoint; the training wrote them."""

_HEAD = "noise_net."
_UNREAD = (f"{_HEAD}enc_pos.pe", ".num_batches_tracked")
_AGENT_CLASS = "data4robotics.models.diffusion.DiffusionTransformerAgent"
_RESNET_CLASS = "data4robotics.models.resnet.ResNet"
_MOST, _MOST_LAYERS, _MOST_STEPS, _MOST_CAMERAS = 2**16, 512, 4096, 64
"""Sizes above these are no policy's. Whether the weights are there for them is asked later."""

_REMEDY = (
    f"Give the {AGENT} that the training wrote. For another network build it with the code that trained it, and use"
    " ttscompile.compile_denoiser(module, spec): its noise_net is the module, and its tokens are the observation."
)


class _Encoder(nn.Module):
    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads)
        self.linear1, self.linear2 = nn.Linear(width, hidden), nn.Linear(hidden, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Tensor, position: Tensor) -> Tensor:
        placed = x + position
        x = self.norm1(x + self.self_attn(placed, placed, x, need_weights=False)[0])
        return self.norm2(x + self.linear2(functional.gelu(self.linear1(x), approximate="tanh")))  # type: ignore[no-any-return]


class _Modulation(nn.Module):
    def __init__(self, width: int, shifts: bool) -> None:
        super().__init__()
        self.scale = nn.Linear(width, width)
        self.shift = nn.Linear(width, width) if shifts else None

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        c = functional.silu(c)
        x = x * self.scale(c)[None]
        return x if self.shift is None else x + self.shift(c)[None]


class _Decoder(nn.Module):
    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads)
        self.linear1, self.linear2 = nn.Linear(width, hidden), nn.Linear(hidden, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn_mod1, self.mlp_mod1 = _Modulation(width, True), _Modulation(width, True)
        self.attn_mod2, self.mlp_mod2 = _Modulation(width, False), _Modulation(width, False)

    def forward(self, x: Tensor, time: Tensor, encoded: Tensor) -> Tensor:
        c = encoded.mean(0) + time
        n = self.attn_mod1(self.norm1(x), c)
        x = self.attn_mod2(self.self_attn(n, n, n, need_weights=False)[0], c) + x
        n = self.mlp_mod1(self.norm2(x), c)
        return x + self.mlp_mod2(self.linear2(functional.gelu(self.linear1(n), approximate="tanh")), c)  # type: ignore[no-any-return]


class _Time(nn.Module):
    def __init__(self, waves: int, width: int) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.zeros(waves // 2), requires_grad=False)
        self.out_net = nn.Sequential(nn.Linear(waves, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: Tensor) -> Tensor:
        angle = t[:, None] * self.w[None]
        return self.out_net(torch.cat([angle.cos(), angle.sin()], 1))  # type: ignore[no-any-return]


class DiTPolicyHead(nn.Module):
    """``forward_dec(forward_enc(tokens))``; inputs ``sample [B, T, D]``, ``timestep [B]``, ``tokens [B, S, E]``."""

    def __init__(
        self, width: int, heads: int, layers: int, hidden: int, waves: int, horizon: int, actions: int
    ) -> None:
        super().__init__()
        self.dec_pos = nn.Parameter(torch.zeros(horizon, 1, width))
        self.time_net = _Time(waves, width)
        self.ac_proj = nn.Sequential(
            nn.Linear(actions, actions), nn.GELU(approximate="tanh"), nn.Linear(actions, width)
        )
        self.encoder: Any = nn.Module()
        self.decoder: Any = nn.Module()
        self.encoder.layers = nn.ModuleList(_Encoder(width, heads, hidden) for _ in range(layers))
        self.decoder.layers = nn.ModuleList(_Decoder(width, heads, hidden) for _ in range(layers))
        self.eps_out = ModulatedFinal(width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, tokens: Tensor) -> Tensor:
        """See the class."""
        memory = tokens.transpose(0, 1)
        place = torch.arange(memory.shape[0]).float()[:, None]
        angle = place * torch.exp(torch.arange(0, memory.shape[2], 2).float() * -(math.log(10000.0) / memory.shape[2]))
        position = torch.stack([angle.sin(), angle.cos()], -1).flatten(1)[:, None].repeat(1, memory.shape[1], 1)
        time = self.time_net(timestep)
        x = self.ac_proj(sample).transpose(0, 1) + self.dec_pos
        for encode, decode in zip(self.encoder.layers, self.decoder.layers, strict=True):
            memory = encode(memory, position)
            x = decode(x, time, memory)
        shift, scale = self.eps_out.adaLN_modulation(memory.mean(0) + time).chunk(2, 1)
        return self.eps_out.linear(x * scale[None] + shift[None]).transpose(0, 1)  # type: ignore[no-any-return]


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its checkpoint and the ``agent_config.yaml`` beside it; see ``Family.load``."""
    where = path.parent / AGENT
    settings = Settings(read_yaml(where), f"{where}: ", _REMEDY)
    settings.choice("_target_", _AGENT_CLASS)
    settings.require(share_cam_features=False, early_fusion=False, imgs_per_cam=1)
    config = _tokens_config(settings)
    head, horizon, actions = _head_sizes(settings, config)
    timesteps = settings.number("train_diffusion_steps", 100, MOST_TIMESTEPS)
    loops = ddim_loops(where, settings.number("eval_diffusion_steps", 8), options, num_train_timesteps=timesteps)
    weights = _weights(path)
    of_head = {name.removeprefix(_HEAD): value for name, value in weights.items() if name.startswith(_HEAD)}
    others = {name: value for name, value in weights.items() if not name.startswith(_HEAD)}
    network = filled(lambda: DiTPolicyHead(**head, horizon=horizon, actions=actions), of_head, AGENT, path)
    tokens = filled(lambda: Tokens(config), others, AGENT, path)
    image = ObservationSpec((3, PIXELS, PIXELS), window=False, bounds=(0.0, 1.0))
    observations = {CAMERA.format(i): image for i in range(config.cameras)}
    if config.state:
        observations[STATE] = ObservationSpec((config.state,))
    spec = PolicySpec(
        sample=(horizon, actions),
        observations=observations,
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(actions, 0, horizon, normalizer=_normalizer(path.parent / NORMS, actions)),
        source={"format": "dit_policy", "policy": "DiT-Policy", "encoder": config.network, **loops.source},
    )
    return EncodedDenoiser(Observed(tokens), network).eval(), spec


def _weights(path: Path) -> dict[str, Tensor]:
    """Those of the agent, without the table of positions, which is computed."""
    model = read_checkpoint(path).get("model")
    if not isinstance(model, dict):
        found = type(model).__name__
        raise CheckpointError(f"{path}: its entry 'model' is a {found}; expected weights by name. Give what was saved.")
    return as_float32({name: value for name, value in model.items() if not str(name).endswith(_UNREAD)}, f"{path}: ")


def _tokens_config(settings: Settings) -> TokensConfig:
    features = settings.part("features")
    features.choice("_target_", _RESNET_CLASS)
    network = f"resnet{features.number('size')}"
    if network not in DEPTHS:
        raise features.refusal("size", " or ".join(name.removeprefix("resnet") for name in DEPTHS))
    norm = features.part("norm_cfg")
    grouped = norm.choice("name", "group_norm", "diffusion_policy") == "group_norm"
    groups = norm.number("num_groups", 16, 64) if grouped else None
    if groups is not None and 64 % groups:  # of the narrowest layer
        raise norm.refusal("num_groups", "a divisor of 64")
    use = settings.values.get("use_obs") or "false"
    if use not in ("false", "add_token", "pad_img_tokens"):
        raise settings.refusal("use_obs", "false, add_token or pad_img_tokens")
    if settings.values.get("feat_norm") not in (None, "layer_norm"):
        raise settings.refusal("feat_norm", "null or layer_norm: another is not rebuilt here")
    projected = settings.values.get("token_dim")
    return TokensConfig(
        cameras=settings.number("n_cams", most=_MOST_CAMERAS),
        network=network,
        groups=groups,
        pooled=features.flag("avg_pool", True),
        state=0 if use == "false" else settings.number("odim", most=_MOST),
        padded=use == "pad_img_tokens",
        projected=None if projected is None else settings.number("token_dim", most=_MOST),
        normed=settings.values.get("feat_norm") is not None,
    )


def _head_sizes(settings: Settings, tokens: TokensConfig) -> tuple[dict[str, int], int, int]:
    """Sizes of the layers, steps of a chunk, and numbers of an action."""
    sizes = settings.part("noise_net_kwargs")
    sizes.require(activation="gelu")
    head = {
        "width": sizes.number("hidden_dim", 512, _MOST),
        "heads": sizes.number("nhead", 8, _MOST),
        "layers": sizes.number("num_blocks", 6, _MOST_LAYERS),
        "hidden": sizes.number("dim_feedforward", 2048, _MOST),
        "waves": sizes.number("time_dim", 256, _MOST),
    }
    if head["width"] != tokens.width:
        raise sizes.refusal("hidden_dim", f"{tokens.width}, which the tokens have", 512)
    if head["width"] % head["heads"] or head["width"] % 2:
        raise sizes.refusal("hidden_dim", f"an even multiple of nhead, {head['heads']}", 512)
    if head["waves"] % 2:
        raise sizes.refusal("time_dim", "an even number")
    return head, settings.number("ac_chunk", most=_MOST_STEPS), settings.number("ac_dim", most=_MOST)


def _normalizer(path: Path, actions: int) -> Affine | None:
    """What the original's evaluation undoes: ``action * scale + loc``."""
    if not path.is_file():
        warnings.warn(
            f"{path}: no such file, so actions are those of the network, in -1..1. The training copies it from the"
            " folder of its data: put it beside the checkpoint and convert again.",
            stacklevel=5,
        )
        return None
    entries = read_json(path)
    try:
        loc, scale = (np.asarray(entries.get(name), dtype=np.float32) for name in ("loc", "scale"))
        if loc.shape != (actions,) or scale.shape != (actions,):
            raise SpecError(
                f"loc and scale have the shapes {loc.shape} and {scale.shape}; expected {actions} numbers each."
            )
        with np.errstate(divide="ignore", invalid="ignore"):
            return Affine(scale=np.float32(1) / scale, offset=-loc / scale)
    except (SpecError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: {error} Copy the file again.") from error
