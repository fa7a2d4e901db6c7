"""Dita's denoiser: a causal Llama over words, images, the timestep and the actions, a token each.

Parameters are called as in the original, ``scripts/llama_dp.py`` of RoboDita/Dita (arXiv 2503.19757), which evaluates
all tokens at every step. No token sees those behind it, so keys and values of the prefix and of the timestep are
computed apart from those of the actions. The ones are computed once a call; the others are made for all steps in one
batch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.refusals import MERGE
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.settings import Settings

from .loops import ddim_loops
from .networks.language_layers import FeedForward, LanguageConfig, Norm
from .yaml_files import read_yaml

CONFIG = Path(".hydra") / "config.yaml"
"""Hydra writes it into the folder of a training; checkpoints are in a folder of that."""

WORDS = 77
"""Tokens of an instruction, with its padding: CLIP's."""

_CHANNELS = 64
"""Of a head, whatever the width is."""

_LLAMA, _FIRST, _LAST = "transformer.", "transformer.model.layers.0.mlp.gate_proj.weight", "transformer.lm_head.weight"
_QUERIES = ("image_tokenizer.qformer.queries", "image_tokenizer.qformer.latents")
_UNREAD = ".rotary_emb.inv_freq"  # older versions of transformers saved it; computed here
_MOST_STEPS = 4096

_REMEDY = (
    f"Give the {CONFIG} that hydra wrote for this training. For a released checkpoint write one with dataset:"
    " {traj_length: N}, num_pred_action, scheduler_type, prediction_type and num_inference_steps, as its authors'"
    " command has them."
)


Cache = list[tuple[Tensor, Tensor]]


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj, self.k_proj, self.v_proj, self.o_proj = (nn.Linear(width, width, bias=False) for _ in range(4))

    def forward(self, x: Tensor, past: tuple[Tensor, Tensor] | None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        q, k, v = (
            p(x).unflatten(-1, (self.heads, -1)).transpose(1, 2) for p in (self.q_proj, self.k_proj, self.v_proj)
        )
        before = 0 if past is None else past[0].shape[2]
        q, k = _rotated(q, before), _rotated(k, before)
        if past is not None:
            k, v = torch.cat([past[0], k], 2), torch.cat([past[1], v], 2)
        mask = torch.ones(x.shape[1], before + x.shape[1], dtype=torch.bool).tril(before)
        y = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.o_proj(y.transpose(1, 2).flatten(2)), (k, v)


def _rotated(x: Tensor, start: int) -> Tensor:
    """Rotary embedding of ``[B, H, T, C]`` from a position on, the two halves of the channels as pairs."""
    rates = 1.0 / 10000 ** (torch.arange(0, x.shape[-1], 2).float() / x.shape[-1])
    angle = torch.arange(start, start + x.shape[2]).float()[:, None] * rates.repeat(2)
    left, right = x.chunk(2, -1)
    return x * angle.cos() + torch.cat([-right, left], -1) * angle.sin()


class _Layer(nn.Module):
    def __init__(self, config: LanguageConfig) -> None:
        super().__init__()
        self.self_attn, self.mlp = _Attention(config.width, config.heads), FeedForward(config)
        self.input_layernorm, self.post_attention_layernorm = Norm(config), Norm(config)

    def forward(self, x: Tensor, past: tuple[Tensor, Tensor] | None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        y, own = self.self_attn(self.input_layernorm(x), past)
        x = x + y
        return x + self.mlp(self.post_attention_layernorm(x)), own


class DitaHead(nn.Module):
    """``forward`` on the tokens of the prefix; inputs ``sample [B, T, D]``, ``timestep [B]``, ``prefix [B, P, E]``.

    The prefix is the words of the instruction (CLIP), then the tokens of the frames.
    """

    def __init__(self, width: int, heads: int, hidden: int, layers: int, actions: int) -> None:
        super().__init__()
        self.width = width
        self.transformer: Any = nn.Module()
        self.transformer.model = nn.Module()
        config = LanguageConfig(width, hidden, layers, heads, heads, width // heads)
        self.transformer.model.layers = nn.ModuleList(_Layer(config) for _ in range(layers))
        self.transformer.model.norm = Norm(config)
        self.transformer.lm_head = nn.Linear(width, actions, bias=False)

    def _through(self, x: Tensor, past: Cache | None) -> tuple[Tensor, Cache]:
        """Tokens behind those whose keys and values are given, and the keys and values of both."""
        layers = self.transformer.model.layers
        every = []
        for layer, seen in zip(layers, [None] * len(layers) if past is None else past, strict=True):
            x, own = layer(x, seen)
            every.append(own)
        return x, every

    def forward(self, sample: Tensor, timestep: Tensor, prefix: Tensor) -> Tensor:
        """See the class."""
        half = self.width // 2
        wave = timestep[:, None] * torch.exp(torch.arange(half) * (-math.log(10000) / (half - 1)))
        time = torch.cat([wave.sin(), wave.cos()], -1)[:, None]
        actions = functional.pad(sample, (0, self.width - sample.shape[-1]))
        past: Cache | None = None
        for before in (prefix, time):
            _, past = self._through(before, past)
        x, _ = self._through(actions, past)
        return self.transformer.lm_head(self.transformer.model.norm(x))  # type: ignore[no-any-return]


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a head from a checkpoint and the configuration of its training; see ``Family.load``."""
    where = next(each for each in config_files(path) if each.is_file())
    settings = Settings(read_yaml(where), f"{where}: ", _REMEDY)
    settings.require(use_action_head_diff=0, dim_align_type=0, abs_sup=0, cfg=0)
    horizon, predicted = _lengths(settings)
    saved = _saved(path)
    width, hidden, layers, actions = _sizes(path, saved)
    weights = {name: value for name, value in saved.items() if name.startswith(_LLAMA) and not name.endswith(_UNREAD)}
    network = filled(
        lambda: DitaHead(width, width // _CHANNELS, hidden, layers, actions),
        as_float32(weights, f"{path}: "),
        "A Llama of the width of its first layer",
        path,
    )
    frames = horizon - predicted + 1
    prefix = WORDS + frames * _tokens(path, saved)
    # Of the original's two schedules the one has a thousand timesteps, as diffusers has where nothing is said.
    linear = settings.number("scheduler_type", 0, least=0) == 1
    schedule: dict[str, Any] = {"beta_schedule": "linear"} if linear else {"num_train_timesteps": 100}
    schedule["prediction_type"] = settings.choice("prediction_type", "epsilon", "sample", "v_prediction")
    loops = ddim_loops(where, settings.number("num_inference_steps", 10), options, **schedule)
    spec = PolicySpec(
        sample=(horizon, actions),
        observations={"prefix": ObservationSpec((prefix, width), window=False)},
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(actions, frames - 1, horizon),
        source={"format": "dita", "policy": "Dita", "frames": str(frames), **loops.source},
    )
    return network.eval(), spec


def config_files(path: Path) -> tuple[Path, Path]:
    """Where the configuration of a checkpoint may be."""
    return path.parent / CONFIG, path.parent.parent / CONFIG


def _lengths(settings: Settings) -> tuple[int, int]:
    """Steps of the sample, and those of them that are actions to come; the others are of the frames before the last."""
    own = settings.part("dataset")
    predicted = settings.number("num_pred_action", 1, _MOST_STEPS)
    wrapped = settings.number("wrap_grmg_data", 0, 2, least=0)
    horizon = predicted + wrapped - 1 if wrapped else own.number("traj_length", most=_MOST_STEPS)
    if predicted > horizon:
        raise settings.refusal("num_pred_action", f"{horizon} at most, of dataset.traj_length")
    return horizon, predicted


def _saved(path: Path) -> Mapping[str, Any]:
    """What was saved of the network; under ``parameter``, or alone."""
    payload = read_checkpoint(path)
    saved = payload.get("parameter", payload)
    if not isinstance(saved, dict):
        found = type(saved).__name__
        raise CheckpointError(
            f"{path}: its entry 'parameter' is a {found}; expected weights by name. Give what was saved."
        )
    names = [str(name) for name in saved]
    if adapted := next((name for name in names if ".lora_A." in name), None):
        raise CheckpointError(f"{path}: holds an adapter (LoRA: {adapted:.120}). {MERGE}")
    return {str(name).replace("_orig_mod.", "").removeprefix("module."): value for name, value in saved.items()}


def _sizes(path: Path, saved: Mapping[str, Any]) -> tuple[int, int, int, int]:
    """Width, width inside the feed-forward layers, layers, and numbers of an action."""
    first, last = saved.get(_FIRST), saved.get(_LAST)
    for name, value in ((_FIRST, first), (_LAST, last)):
        if not isinstance(value, Tensor) or value.ndim != 2:
            raise CheckpointError(
                f"{path}: no weight {name}, a matrix; expected a checkpoint of Dita's network. {_REMEDY}"
            )
    assert isinstance(first, Tensor) and isinstance(last, Tensor)
    hidden, width = first.shape
    if width % _CHANNELS or not width:
        raise CheckpointError(f"{path}: weight {_FIRST} is {width} wide; expected a multiple of {_CHANNELS}. {_REMEDY}")
    layers = len({name.split(".")[3] for name in saved if name.startswith(f"{_LLAMA}model.layers.")})
    return width, hidden, layers, last.shape[0]


def _tokens(path: Path, saved: Mapping[str, Any]) -> int:
    """Of a frame."""
    queries = next((saved[name] for name in _QUERIES if name in saved), None)
    if not isinstance(queries, Tensor) or queries.ndim < 2:
        raise CheckpointError(
            f"{path}: neither weight {' nor '.join(_QUERIES)}, whose rows are the tokens of a frame; expected a Dita"
            f" with use_qformer. {_REMEDY}"
        )
    return queries.shape[-2]
