"""ScaleDP, the action head of DexVLA: a DiT with adaLN-Zero, modulated by the sum of timestep and observation.

Parameters are called as in the original, ``policy_heads`` of juruobenruo/DexVLA (arXiv 2502.05855). On the robot that
computes in bfloat16, and here all is float32. It rounds the waves of its timestep to bfloat16 whatever its weights are,
and so they are rounded here.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.scheduler import MOST_TIMESTEPS
from ttscompile.frontends.settings import Settings, read_json

from .loops import ddim_loops
from .networks.layers import ModulatedFinal, TimmAttention, TimmMlp
from .shards import read_part

CONFIG, BESIDE_ADAPTER = "config.json", "non_lora_trainables.bin"
"""What is trained in whole beside a LoRA adapter of the language model: the head is in it."""

STRUCTURES: Mapping[str, Mapping[str, int]] = {
    "ScaleDP_H": {"depth": 32, "n_emb": 1280, "num_heads": 16},
    "ScaleDP_L": {"depth": 24, "n_emb": 1024, "num_heads": 16},
}
"""By ``policy_head_size``; the original takes them from there."""

_MOST, _MOST_LAYERS, _MOST_STEPS = 2**16, 512, 4096
"""Sizes above these are no head's. Whether the weights are there for them is asked later."""

_NESTED = re.compile(r"^(?:base_model\.)?(?:model\.)?policy_head\.")


class _Timestep(nn.Module):
    """An artifact has no bfloat16: the waves of each training timestep are a table, and take no part in the capture."""

    waves: Tensor

    def __init__(self, width: int, timesteps: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(256, width), nn.SiLU(), nn.Linear(width, width))
        # On the processor even while the network has no memory yet: no weight of the checkpoint replaces them.
        rates = torch.exp(-math.log(10000) * torch.arange(128, dtype=torch.bfloat16, device="cpu") / 128)
        angle = torch.arange(timesteps, device="cpu")[:, None].float() * rates
        waves = torch.cat([angle.cos(), angle.sin()], -1).bfloat16().float()
        self.register_buffer("waves", waves, persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        return self.mlp(self.waves[t.long()])  # type: ignore[no-any-return]


def _modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return functional.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale[:, None]) + shift[:, None]


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.mlp = TimmAttention(width, heads), TimmMlp(width)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        shift, scale, gate, shift2, scale2, gate2 = self.adaLN_modulation(c).chunk(6, 1)
        x = x + gate[:, None] * self.attn(_modulated(x, shift, scale))
        return x + gate2[:, None] * self.mlp(_modulated(x, shift2, scale2))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class ScaleDPConfig:
    """Sizes of a head.

    Attributes:
        hidden: width of the layers that join features and state; a number in the original's code, no setting.
        features: numbers of the vector that the vision-language model leaves.
        timesteps: of training.
    """

    width: int
    heads: int
    layers: int
    horizon: int
    actions: int
    features: int
    state: int
    hidden: int = 1024
    timesteps: int = 100


class ScaleDPHead(nn.Module):
    """``model_forward``; inputs ``sample [B, T, D]``, ``timestep [B]``, ``features [B, 1, .]``, ``state [B, .]``.

    ``features`` is what the vision-language model leaves after FiLM, ``action_hidden_states`` in the original.
    """

    def __init__(self, config: ScaleDPConfig) -> None:
        super().__init__()
        features, hidden, width = config.features, config.hidden, config.width
        self.combine = nn.Sequential(
            nn.Linear(features + config.state, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, features),
        )
        self.x_embedder, self.t_embedder = nn.Linear(config.actions, width), _Timestep(width, config.timesteps)
        self.cond_obs_emb = nn.Linear(features, width)
        self.pos_embed = nn.Parameter(torch.zeros(1, config.horizon, width))
        self.blocks = nn.ModuleList(_Layer(width, config.heads) for _ in range(config.layers))
        self.final_layer = ModulatedFinal(width, config.actions)

    def forward(self, sample: Tensor, timestep: Tensor, features: Tensor, state: Tensor) -> Tensor:
        """See the class."""
        observed = self.cond_obs_emb(self.combine(torch.cat([features[:, 0], state], -1)))
        c = self.t_embedder(timestep) + observed
        x = self.x_embedder(sample) + self.pos_embed
        for layer in self.blocks:
            x = layer(x, c)
        shift, scale = self.final_layer.adaLN_modulation(c).chunk(2, 1)
        return self.final_layer.linear(_modulated(x, shift, scale))  # type: ignore[no-any-return]


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a head from the directory of a DexVLA, or of its ``policy_head`` alone; see ``Family.load``."""
    weights = _head_weights(path)
    config, steps = _read_config(path, weights.get("combine.0.bias", torch.empty(1024)).numel())
    network = filled(lambda: ScaleDPHead(config), weights, f"policy_head_config in {CONFIG}", path)
    loops = ddim_loops(path / CONFIG, steps, options, num_train_timesteps=config.timesteps)
    warnings.warn(
        f"{path}: DexVLA's statistics are a pickle (dataset_stats.pkl), and pickles are not opened. So give the state"
        " as (state - qpos_mean) / qpos_std, and expect actions in -1..1: the robot's are action_min + (action + 1) / 2"
        " * (action_max - action_min).",
        stacklevel=4,
    )
    spec = PolicySpec(
        sample=(config.horizon, config.actions),
        observations={
            "features": ObservationSpec((1, config.features), window=False),
            "state": ObservationSpec((config.state,)),
        },
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(config.actions, 0, config.horizon),
        source={"format": "scaledp", "policy": "ScaleDP", **loops.source},
    )
    return network.eval(), spec


def _read_config(path: Path, hidden: int) -> tuple[ScaleDPConfig, int]:
    """Sizes, and the number of steps."""
    settings = _head_settings(path)
    settings.require(mlp_ratio=4, is_tinyvla=False)
    config = ScaleDPConfig(
        width=settings.number("n_emb", most=_MOST),
        heads=settings.number("num_heads", most=_MOST),
        layers=settings.number("depth", most=_MOST_LAYERS),
        horizon=settings.number("prediction_horizon", most=_MOST_STEPS),
        actions=settings.number("input_dim", most=_MOST),
        features=settings.number("cond_dim", most=_MOST),
        state=settings.number("state_dim", most=_MOST),
        hidden=hidden,
        timesteps=settings.number("num_train_timesteps", 100, MOST_TIMESTEPS),
    )
    if config.width % config.heads:
        raise settings.refusal("n_emb", f"a multiple of num_heads, {config.heads}")
    return config, settings.number("num_inference_timesteps", 10)


def _head_settings(path: Path) -> Settings:
    """The entries of the head: ``policy_head_config`` of a whole DexVLA's, or all of them."""
    entries = read_json(path / CONFIG)
    where = f"{path / CONFIG}: "
    remedy = (
        "Give what DexVLA's training saved, its second or third stage. For another network build it with the code that"
        " trained it, and use ttscompile.compile_denoiser(module, spec)."
    )
    if entries.get("model_type") == "scale_dp_policy":
        return Settings(entries, where, remedy)
    whole = Settings(entries, where, remedy)
    head: Any = entries.get("policy_head_config")
    if not isinstance(head, dict):
        raise whole.refusal("policy_head_config", "the entries of a ScaleDP")
    structure = STRUCTURES.get(str(entries.get("policy_head_size")), {})
    if wrong := [name for name, size in structure.items() if head.get(name, size) != size]:
        size = f"{structure[wrong[0]]} of policy_head_size {entries['policy_head_size']}"
        raise whole.error(f"policy_head_config.{wrong[0]} is {head[wrong[0]]!r:.80}; expected {size}")
    return Settings({**structure, **head}, f"{where}policy_head_config.", remedy)


def _head_weights(path: Path) -> dict[str, Tensor]:
    """The weights of the head, as float32, without the language model's, which are not read."""
    if (path / BESIDE_ADAPTER).is_file():
        found = read_checkpoint(path / BESIDE_ADAPTER)
        kept = {_NESTED.sub("", name): value for name, value in found.items() if _NESTED.match(str(name))}
        return as_float32(kept, f"{path / BESIDE_ADAPTER}: ")
    return as_float32(read_part(path, "policy_head."), f"{path}: ")
