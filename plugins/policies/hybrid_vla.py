"""HybridVLA's diffusion: timestep and noisy action are the last tokens of its language model, a Llama 2.

Attention is causal, so keys and values of all tokens before the timestep are computed once a call, those of the
timestep for all steps in one batch, and the loop has the tokens of the actions alone. The original keeps the former,
too, when it runs DDIM. With several actions a call it keeps some tokens of earlier steps beside them; here, as in its
training, each step sees its own alone.

Images and words are embedded outside, as ``_prepare_multimodal_inputs`` does it; the robot's state is embedded here.
Parameters are called as in a checkpoint. On the robot the original computes in bfloat16, and here all is float32.

Source: ``PrismaticVLM.forward`` and ``HybridVLA.predict_action`` of PKU-HMI-Lab/Hybrid-VLA at 64ed480 (arXiv
2503.10631).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled, require_memory_for
from ttscompile.frontends.settings import Settings, read_json

from .loops import respaced_loops
from .networks.language_layers import LanguageConfig, Layer, Norm, Rotation, Seen, added, rotate, rotation
from .networks.layers import TimestepEmbedder
from .quantiles import GRIPPER, Range, read_statistics

CONFIG, LENGTH = "config.json", "prefix_tokens"
"""The configuration beside the folder of checkpoints, and what has to be added to it."""
STEPS = 4
"""Of its scripts."""

_CHANNELS, _EPSILON = 128, 1e-5
"""Of a head of Llama 2, of any size, and of its norms."""
_PARTS = ("x_embedder", "t_embedder", "proprio_embedder", "final_layer")
_LLAMA, _LAST, _UNREAD = "llm.model.", "llm.model.norm.weight", ".rotary_emb.inv_freq"
_MOST_TOKENS, _MOST_ACTIONS = 4096, 256
_REMEDY = (
    f"Put beside the folder checkpoints the {CONFIG} that its training wrote, and add {LENGTH} to it: how many tokens"
    " stand before the state at most, 1 and 256 for each camera and those of the longest instruction."
)


class _Mlp(nn.Module):
    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(inputs, width), nn.Linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x), approximate="tanh"))  # type: ignore[no-any-return]


class _Embedder(nn.Module):
    def __init__(self, numbers: int, width: int) -> None:
        super().__init__()
        self.mlp = _Mlp(numbers, width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.mlp(x)  # type: ignore[no-any-return]


class _VarianceNorm(nn.Module):
    """timm's before 1.0.13: it divides by the root of the variance, and not of the mean square."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.var(-1, keepdim=True) + 1e-6) * self.weight


class _Final(nn.Module):
    def __init__(self, width: int, actions: int) -> None:
        super().__init__()
        self.norm_final, self.mlp = _VarianceNorm(width), _Mlp(width, width, actions)

    def forward(self, x: Tensor) -> Tensor:
        return self.mlp(self.norm_final(x))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Sizes:
    """Of a network.

    Attributes:
        groups: heads of keys and values.
        hidden: width inside the feed-forward layers.
    """

    width: int
    hidden: int
    layers: int
    groups: int
    actions: int


class HybridVLAHead(nn.Module):
    """``PrismaticVLM.forward`` from the embedded tokens on.

    Inputs: ``sample [B, T, D]``, ``timestep [B]``, ``prefix [B, P, E]``, ``prefix_mask [B, P]``, ``state [B, D]``.
    Padding of the prefix stands before it: where a token stands relative to the others is all that matters.

    Args:
        seen: the range of the state in its own units; None where it is given as the network sees it.
    """

    low: Tensor
    width: Tensor
    mask: Tensor

    def __init__(self, sizes: Sizes, seen: Range | None = None) -> None:
        super().__init__()
        count, width = sizes.actions, sizes.width
        low, high, mask = (np.zeros(count), np.ones(count), np.zeros(count, bool))
        if seen is not None:
            low, high, mask = seen.low, seen.high, seen.mask
        # On the processor even while the network has no memory yet: no weight of the checkpoint replaces them.
        for name, value in (("low", low), ("width", high - low + 1e-8), ("mask", mask)):
            made = torch.tensor(value, device="cpu", dtype=torch.bool if name == "mask" else torch.float32)
            self.register_buffer(name, made, persistent=False)
        heads = width // _CHANNELS
        config = LanguageConfig(width, sizes.hidden, sizes.layers, heads, sizes.groups, _CHANNELS, _EPSILON)
        self.llm: Any = nn.Module()
        self.llm.model = nn.Module()
        self.llm.model.layers = nn.ModuleList(Layer(config) for _ in range(sizes.layers))
        self.llm.model.norm = Norm(config)
        self.x_embedder, self.proprio_embedder = _Embedder(count, width), _Embedder(count, width)
        self.t_embedder, self.final_layer = TimestepEmbedder(width), _Final(width, count)

    def forward(self, sample: Tensor, timestep: Tensor, prefix: Tensor, prefix_mask: Tensor, state: Tensor) -> Tensor:
        """See the class."""
        scaled = torch.where(self.mask, 2 * (state - self.low) / self.width - 1, state).clamp(-1, 1)
        before = torch.cat([prefix, self.proprio_embedder(scaled)[:, None]], 1)
        past: list[Seen] | None = None
        for tokens in (before, self.t_embedder(timestep)[:, None]):
            _, past = self._through(tokens, past, prefix_mask)
        x, _ = self._through(self.x_embedder(sample), past, prefix_mask)
        return self.final_layer(self.llm.model.norm(x))  # type: ignore[no-any-return]

    def _through(self, x: Tensor, past: list[Seen] | None, there: Tensor) -> tuple[Tensor, list[Seen]]:
        """Tokens behind those whose keys and values are given, and the keys and values of both."""
        layers = self.llm.model.layers
        start, count = 0 if past is None else past[0].keys.shape[2], x.shape[1]
        seen = torch.ones(count, start + count, dtype=torch.bool, device=x.device).tril(start)
        more = start + count - there.shape[1]
        mask = added(seen & functional.pad(there, (0, more), value=True)[:, None, None])
        turns = rotation(torch.arange(start, start + count, device=x.device)[None], _CHANNELS)
        every = []
        for layer, known in zip(layers, [None] * len(layers) if past is None else past, strict=True):
            x, own = _layer(layer, x, known, turns, mask)
            every.append(own)
        return x, every


def _layer(layer: Any, x: Tensor, past: Seen | None, turns: Rotation, mask: Tensor) -> tuple[Tensor, Seen]:
    attention, normed = layer.self_attn, layer.input_layernorm(x)
    keys = rotate(attention.split(attention.k_proj(normed)), turns)
    own = Seen(attention.for_all_heads(keys), attention.for_all_heads(attention.split(attention.v_proj(normed))))
    seen = own if past is None else Seen(*(torch.cat(both, 2) for both in zip(past, own, strict=True)))
    x = x + attention.attend(rotate(attention.split(attention.q_proj(normed)), turns), seen, mask)
    return x + layer.mlp(layer.post_attention_layernorm(x)), seen


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild the diffusion of a HybridVLA from its checkpoint; see ``Family.load``."""
    where = path.absolute().parents[1] / CONFIG
    if not where.is_file():
        raise CheckpointError(f"{path}: no {where}. {_REMEDY}")
    settings = Settings(read_json(where), f"{where}: ", _REMEDY)
    tokens = settings.number(LENGTH, most=_MOST_TOKENS)
    horizon = settings.number("future_action_window_size", 15, _MOST_ACTIONS, least=0) + 1
    weights = _weights(path)
    sizes = _sizes(path, weights)
    count = sizes.actions
    grippers = {7: (GRIPPER,), 14: (GRIPPER, GRIPPER + 7)}.get(count, ())
    own = read_statistics(path, count, grippers, state=count)
    network = filled(lambda: HybridVLAHead(sizes, own.state), weights, "a Llama 2 as wide as the last norm", path)
    loops = respaced_loops(where, STEPS, options)
    seen = None if own.state is None else (tuple(own.state.low.tolist()), tuple(own.state.high.tolist()))
    spec = PolicySpec(
        sample=(horizon, count),
        observations={
            "prefix": ObservationSpec((tokens, sizes.width), window=False),
            "prefix_mask": ObservationSpec((tokens,), dtype="bool", window=False, bounds=(0.0, 1.0)),
            "state": ObservationSpec((count,), bounds=seen),
        },
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(count, 0, horizon, own.normalizer, switches=own.switches),
        source={"format": "hybrid_vla", "policy": "HybridVLA", "statistics": own.name, **loops.source},
    )
    return network.eval(), spec


def _weights(path: Path) -> dict[str, Tensor]:
    """Those of the language model, without its words, and of what diffuses; the images' stay on the disk."""
    payload: Any = read_checkpoint(path, mapped=True).get("model")
    parts = payload if isinstance(payload, dict) else {}
    for name in ("llm_backbone", *_PARTS):
        if not isinstance(parts.get(name), Mapping):
            raise CheckpointError(
                f"{path}: no entry model.{name}; expected the weights of a HybridVLA that was trained with use_diff:"
                " without it, it says its actions as words, and nothing denoises."
            )
    read = (f"{_LLAMA}layers.", _LAST)
    found = {name: value for name, value in parts["llm_backbone"].items() if str(name).startswith(read)}
    found |= {f"{part}.{name}": value for part in _PARTS for name, value in parts[part].items()}
    found = {str(name): value for name, value in found.items() if not str(name).endswith(_UNREAD)}
    tensors = (value for value in found.values() if isinstance(value, Tensor))
    require_memory_for(path, ((each.numel(), each.dtype == torch.float32) for each in tensors))
    return as_float32(found, f"{path}: ")


def _sizes(path: Path, weights: Mapping[str, Tensor]) -> Sizes:
    shapes = []
    layer = f"{_LLAMA}layers.0."
    for name in (f"{layer}mlp.gate_proj.weight", f"{layer}self_attn.k_proj.weight", "x_embedder.mlp.fc1.weight"):
        if name not in weights or weights[name].ndim != 2:
            found = f"shape {tuple(weights[name].shape)}" if name in weights else "none"
            raise CheckpointError(
                f"{path}: {name} must be a matrix; found {found}. Expected a HybridVLA on Llama 2; one on Phi-2 is not"
                " rebuilt here."
            )
        shapes.append(tuple(weights[name].shape))
    (hidden, width), (keys, _), (_, actions) = shapes
    if not width or width % _CHANNELS or not keys or keys % _CHANNELS or width % keys:
        raise CheckpointError(
            f"{path}: its Llama is {width} wide, and its keys {keys}; expected multiples of {_CHANNELS}, as in Llama 2."
        )
    layers = len({name.split(".")[3] for name in weights if name.startswith(f"{_LLAMA}layers.")})
    return Sizes(width, hidden, layers, keys // _CHANNELS, actions)
