"""RDT-1B, read from the directory that its ``save_pretrained`` wrote: config.json beside its weights.

Source: ``RDTRunner`` of thu-ml/RoboticsDiffusionTransformer at deb71d8. What is compiled is ``predict_action``, and its
arguments are the observations: what T5 gives is one of them, and what SigLIP gives another, or the pictures
(``rdt_cameras``).

The network has self-attention, cross-attention to language or image by turns, and feed-forward. Parameters are called
as in a checkpoint. The norm divides by the deviation, not by the root of the mean square: that is what timm 1.0.3 does,
which RDT was trained with.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import WITHOUT, ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled, read_tensors, require_memory, require_memory_for
from ttscompile.frontends.scheduler import configured_loops
from ttscompile.frontends.settings import Settings, read_json

from .last_step import changed, marked, unmarked
from .networks.layers import TimestepEmbedder, TimmMlp, split
from .rdt_cameras import Cameras, Pictures, find_cameras

CONFIG, WEIGHTS, PICKLED = "config.json", "model.safetensors", "pytorch_model.bin"
_MOST, _MOST_LAYERS, _MOST_DEPTH = 2**16, 512, 16
"""Sizes above these are no policy's. Whether the weights are there for them is asked later."""
_REMEDY = (
    "Give the folder as RDT's save_pretrained wrote it. For another network build it with the code that trained it, and"
    " use ttscompile.compile_denoiser(module, spec)."
)
_USUAL_HZ = (1.0, 66.6)
"""Rates of control that RDT was trained with."""


@dataclass(frozen=True)
class RDTConfig:
    """Sizes of a network.

    Attributes:
        horizon: actions of a chunk.
        actions: numbers of an action; of a state, too.
        lengths: tokens of language, at most, and of the images.
        features: of a token of language, and of an image's.
        depths: linear layers of the adaptors of language, image and state; 0 for one without a number in its name.
    """

    width: int
    heads: int
    layers: int
    horizon: int
    actions: int
    lengths: tuple[int, int]
    features: tuple[int, int]
    depths: tuple[int, int, int] = (2, 2, 3)


class _Norm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.var(-1, keepdim=True) + 1e-6) * self.weight


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int, crosses: bool) -> None:
        super().__init__()
        self.heads, self.crosses = heads, crosses
        if crosses:
            self.q, self.kv = nn.Linear(width, width), nn.Linear(width, 2 * width)
        else:
            self.qkv = nn.Linear(width, 3 * width)
        self.q_norm, self.k_norm = _Norm(width // heads), _Norm(width // heads)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """``memory [B, S, E]`` to attend to, or x itself; mask bool ``[B, S]``."""
        parts = self.qkv(x).chunk(3, -1) if memory is None else (self.q(x), *self.kv(memory).chunk(2, -1))
        q, k, v = (split(part, self.heads) for part in parts)
        seen = None if mask is None else mask[:, None, None].expand(-1, -1, x.shape[1], -1)
        y = functional.scaled_dot_product_attention(self.q_norm(q), self.k_norm(k), v, attn_mask=seen)
        added: Tensor = self.proj(y.transpose(1, 2).flatten(2))
        return added


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.cross_attn = _Attention(width, heads, False), _Attention(width, heads, True)
        self.norm1, self.norm2, self.norm3 = (_Norm(width) for _ in range(3))
        self.ffn = TimmMlp(width, times=1)

    def forward(self, x: Tensor, memory: Tensor, mask: Tensor | None) -> Tensor:
        x = self.attn(self.norm1(x)) + x
        x = self.cross_attn(self.norm2(x), memory, mask) + x
        done: Tensor = self.ffn(self.norm3(x)) + x
        return done


class _Final(nn.Module):
    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.norm_final, self.ffn_final = _Norm(width), TimmMlp(width, out, times=1)


class _RDT(nn.Module):
    def __init__(self, config: RDTConfig) -> None:
        super().__init__()
        width, self.horizon = config.width, config.horizon
        self.t_embedder, self.freq_embedder = TimestepEmbedder(width), TimestepEmbedder(width)
        self.x_pos_embed = nn.Parameter(torch.zeros(1, config.horizon + 3, width))
        self.lang_cond_pos_embed = nn.Parameter(torch.zeros(1, config.lengths[0], width))
        self.img_cond_pos_embed = nn.Parameter(torch.zeros(1, config.lengths[1], width))
        self.blocks = nn.ModuleList(_Layer(width, config.heads) for _ in range(config.layers))
        self.final_layer = _Final(width, config.actions)

    def forward(self, x: Tensor, frequency: Tensor, t: Tensor, language: Tensor, image: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.t_embedder(t)[:, None], self.freq_embedder(frequency)[:, None], x], 1) + self.x_pos_embed
        language = language + self.lang_cond_pos_embed[:, : language.shape[1]]
        image = image + self.img_cond_pos_embed
        for i, layer in enumerate(self.blocks):
            x = layer(x, image, None) if i % 2 else layer(x, language, mask)
        done: Tensor = self.final_layer.ffn_final(self.final_layer.norm_final(x))[:, -self.horizon :]
        return done


def _adaptor(features: int, width: int, depth: int) -> nn.Module:
    if not depth:
        return nn.Linear(features, width)
    layers: list[nn.Module] = [nn.Linear(features, width)]
    for _ in range(depth - 1):
        layers += [nn.GELU(approximate="tanh"), nn.Linear(width, width)]
    return nn.Sequential(*layers)


class RDTHead(nn.Module):
    """The parameters of ``RDTRunner``; ``compiled`` makes of them what is evaluated."""

    def __init__(self, config: RDTConfig) -> None:
        super().__init__()
        self.model = _RDT(config)
        width, (language, image, state) = config.width, config.depths
        self.lang_adaptor = _adaptor(config.features[0], width, language)
        self.img_adaptor = _adaptor(config.features[1], width, image)
        self.state_adaptor = _adaptor(2 * config.actions, width, state)

    def compiled(self, cameras: Cameras | None = None) -> EncodedDenoiser:
        """The original evaluates the adaptors of what is observed once a call, and the rest at every step.

        Args:
            cameras: what makes tokens of pictures; None where tokens are observed.
        """
        return EncodedDenoiser(_Observed(self, cameras), _Denoiser(self))


class _Observed(nn.Module):
    def __init__(self, head: RDTHead, cameras: Cameras | None) -> None:
        super().__init__()
        self.language, self.image, self.state = head.lang_adaptor, head.img_adaptor, head.state_adaptor
        self.pictures = None if cameras is None else Pictures(cameras, head.img_adaptor)

    def forward(self, observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Tokens of language and images ``[B, ., width]``, of the state ``[B, 1, width]``, and what stays as it is."""
        state = torch.cat([observations["state_tokens"], observations["action_mask"]], 2)
        return {
            "language": self.language(observations["lang_tokens"]),
            "image": self.image(observations["img_tokens"]) if self.pictures is None else self.pictures(observations),
            "state": self.state(state),
            "seen": observations["lang_attn_mask"],
            "valid": observations["action_mask"],
            "frequency": observations["ctrl_freqs"][:, 0],
        }


class _Denoiser(nn.Module):
    """One step. At the last, whose timestep is ``marked``, numbers that are no action's are 0, as the original ends."""

    def __init__(self, head: RDTHead) -> None:
        super().__init__()
        self.model, self.state_adaptor = head.model, head.state_adaptor

    def forward(self, sample: Tensor, timestep: Tensor, given: Mapping[str, Tensor]) -> Tensor:
        """``[B, T, D]``, int64 ``[B]`` and what is observed -> ``[B, T, D]``."""
        t, last = unmarked(timestep)
        valid = given["valid"]
        actions = self.state_adaptor(torch.cat([sample, valid.expand(-1, sample.shape[1], -1)], 2))
        x = torch.cat([given["state"], actions], 1)
        clean: Tensor = self.model(x, given["frequency"], t, given["language"], given["image"], given["seen"])
        return clean * torch.where(last[:, None, None], valid, 1.0)


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    where = directory / CONFIG
    settings = Settings(read_json(where), f"{where}: ", _REMEDY)
    config = read_config(settings)
    scheduler = settings.part("noise_scheduler")
    scheduler.require(prediction_type="sample")
    sampler = {
        "_target_": "DPMSolverMultistepScheduler",  # whatever the type: DDPM is of the training
        "num_train_timesteps": scheduler.values.get("num_train_timesteps"),
        "beta_schedule": scheduler.values.get("beta_schedule"),
        "prediction_type": "sample",
        "clip_sample": False,  # which no loop of the original does
    }
    steps = scheduler.number("num_inference_timesteps")
    loops = changed(configured_loops(sampler, steps, options, where=f"{where}: noise_scheduler"), marked)
    head = filled(lambda: RDTHead(config), _weights(directory), CONFIG, directory)
    cameras = find_cameras(directory, settings, (config.lengths[1], config.features[1]), options)
    without = {} if cameras is None or not cameras.absent else {WITHOUT: ", ".join(cameras.absent)}
    spec = PolicySpec(
        sample=(config.horizon, config.actions),
        observations=observed(config, cameras),
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(config.actions, 0, config.horizon),
        source={"format": "rdt", **without, **loops.source},
    )
    return head.compiled(cameras).eval(), spec


def read_config(settings: Settings) -> RDTConfig:
    """Sizes and variant, of the entries that ``RDTRunner`` was made with."""
    rdt = settings.part("rdt")
    width, heads = rdt.number("hidden_size", most=_MOST), rdt.number("num_heads", most=_MOST)
    if width % heads or width // heads < 2:  # the deviation of one number is none
        raise rdt.error(f"hidden_size is {width} with {heads} heads; expected a multiple of the heads, twice at least")
    actions = settings.number("action_dim", most=_MOST)
    if settings.number("state_token_dim", most=_MOST) != actions:
        raise settings.refusal("state_token_dim", f"{actions}, as action_dim is: both go through one adaptor")
    language, image, state = (_depth(settings, f"{name}_adaptor") for name in ("lang", "img", "state"))
    return RDTConfig(
        width=width,
        heads=heads,
        layers=rdt.number("depth", most=_MOST_LAYERS),
        horizon=settings.number("pred_horizon", most=_MOST),
        actions=actions,
        lengths=(settings.number("max_lang_cond_len", most=_MOST), settings.number("img_cond_len", most=_MOST)),
        features=(settings.number("lang_token_dim", most=_MOST), settings.number("img_token_dim", most=_MOST)),
        depths=(language, image, state),
    )


def observed(config: RDTConfig, cameras: Cameras | None) -> dict[str, ObservationSpec]:
    """The arguments of ``predict_action``; language is padded to its longest, and the mask says what of it counts.

    Args:
        cameras: whose pictures are observed in place of tokens.
    """
    (words, patches), (of_word, of_patch) = config.lengths, config.features
    tokens = {"img_tokens": ObservationSpec((patches, of_patch), window=False)}
    return {
        "lang_tokens": ObservationSpec((words, of_word), window=False),
        "lang_attn_mask": ObservationSpec((words,), dtype="bool", window=False, bounds=(0.0, 1.0)),
        **(tokens if cameras is None else cameras.observed),
        "state_tokens": ObservationSpec((1, config.actions), window=False),
        "action_mask": ObservationSpec((1, config.actions), window=False, bounds=(0.0, 1.0)),
        "ctrl_freqs": ObservationSpec((1,), window=False, bounds=_USUAL_HZ),
    }


def _depth(settings: Settings, name: str) -> int:
    value = settings.values.get(name)
    found = re.fullmatch(r"mlp(\d{1,3})x_gelu", value) if isinstance(value, str) else None
    depth = 0 if value == "linear" else int(found[1]) if found else -1
    if value != "linear" and not 1 <= depth <= _MOST_DEPTH:
        raise settings.refusal(name, f"linear, or mlpNx_gelu with N = 1 to {_MOST_DEPTH}")
    return depth


def _weights(directory: Path) -> dict[str, Tensor]:
    """The first file that is there, as the original looks for them, as float32."""
    path = directory / WEIGHTS
    if path.is_file():
        require_memory(path)
        return as_float32(read_tensors(path), f"{path}: ")
    if not (directory / PICKLED).is_file():
        raise CheckpointError(f"{directory}: expected {WEIGHTS} or {PICKLED}; found neither. Copy the directory whole.")
    path = directory / PICKLED
    saved = read_checkpoint(path, mapped=True)
    tensors = (value for value in saved.values() if isinstance(value, Tensor))
    require_memory_for(path, ((each.numel(), each.dtype == torch.float32) for each in tensors))
    return as_float32(saved, f"{path}: ")
