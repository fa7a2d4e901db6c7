"""Octo's network: cameras and instruction to a readout, by a transformer of blocks, and the score network of its head.

Modules are called as in the original's tree of parameters, ``octo/model`` of octo-models/octo at 241fb35 (arXiv
2405.12213); ``flax_files.for_torch`` makes torch's weights of these. Convolutions come with standardised weights. What
is not read of the last layer is not computed there, and of the window's timesteps the head is given the last one alone,
which is the only one that the original returns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import split
from .t5 import T5, Words, word_distances

TOKENS, MASK, PADDING = "language_instruction.input_ids", "language_instruction.attention_mask", "timestep_pad_mask"
DEPTH = "depth_"
"""How keys of depth images begin: floats, which the original takes for pixels of 0..255."""
_EPSILON, _GROUPS = 1e-6, 32
"""Of flax's norms."""
_COLOURS = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""ImageNet's mean and deviation."""


@dataclass(frozen=True)
class Stem:
    """An image tokenizer.

    Attributes:
        keys: of the images that it reads, stacked.
        kind: class of its encoder, as its weights are called.
        channels: of the images, then those of the goal, which an instruction leaves black.
        features: of each convolution.
        layers: kernel, stride and padding of each.
        patch: of the embedding, in what the convolutions leave.
        out: features of a token.
        imagenet: whether colours are normalised as for ImageNet, not to -1..1.
        tokens: of an image.
    """

    keys: tuple[str, ...]
    kind: str
    channels: tuple[int, int]
    features: tuple[int, ...]
    layers: tuple[tuple[int, int, int], ...]
    patch: int
    out: int
    imagenet: bool
    tokens: int


@dataclass(frozen=True)
class Head:
    """Of the diffusion; ``bound`` is the largest number of a sample."""

    horizon: int
    actions: int
    width: int
    waves: int
    blocks: int
    steps: int
    bound: float


@dataclass(frozen=True)
class OctoConfig:
    """Sizes and variant.

    Attributes:
        stems: by name, in the order of their tokens.
        readout: name of the tokens that the head reads, and their number.
        window: timesteps that are observed; positions are known of ``longest``.
        repeated: whether each timestep has the words once more.
        right: whether each token has the rules of its own group. In the models of December 2023 the first token of a
            group has those of the group before.
    """

    width: int
    hidden: int
    layers: int
    heads: int
    window: int
    longest: int
    words: Words
    head: Head
    readout: tuple[str, int]
    stems: Mapping[str, Stem] = field(default_factory=dict)
    repeated: bool = False
    right: bool = False

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Of one timestep: name and number of tokens, as the original has them."""
        seen = [(f"obs_{name}", stem.tokens) for name, stem in self.stems.items()]
        again = [(f"obs_task_{self.words.name}", self.words.length)] if self.repeated else []
        return [*seen, *again, (f"readout_{self.readout[0]}", self.readout[1])]


class _Stem(nn.Module):
    def __init__(self, config: Stem) -> None:
        super().__init__()
        self.config, before = config, sum(config.channels)
        encoder = nn.Module()
        for i, (after, (kernel, stride, padding)) in enumerate(zip(config.features, config.layers, strict=True)):
            encoder.add_module(f"StdConv_{i}", nn.Conv2d(before, after, kernel, stride, padding))
            encoder.add_module(f"GroupNorm_{i}", nn.GroupNorm(_GROUPS, after, _EPSILON))
            before = after
        encoder.add_module("embedding", nn.Conv2d(before, config.out, config.patch, config.patch))
        self.add_module(f"{config.kind}_0", encoder)

    def forward(self, images: Tensor) -> Tensor:
        """``[B, T, C, H, W]`` in 0..1 to tokens ``[B, T, N, E]``."""
        encoder = self.get_submodule(f"{self.config.kind}_0")
        x = functional.pad(images.flatten(0, 1), (0, 0, 0, 0, 0, self.config.channels[1]))
        if self.config.imagenet:
            mean, deviation = (torch.tensor(each).repeat(x.shape[1] // 3)[:, None, None] for each in _COLOURS)
            x = (x - mean) / deviation
        else:
            x = 2 * x - 1
        for i in range(len(self.config.features)):
            x = encoder.get_submodule(f"GroupNorm_{i}")(encoder.get_submodule(f"StdConv_{i}")(x)).relu()
        x = encoder.get_submodule("embedding")(x)
        return x.flatten(2).transpose(1, 2).unflatten(0, (-1, images.shape[1]))  # type: ignore[no-any-return]


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))

    def forward(self, asking: Tensor, x: Tensor, seen: Tensor) -> Tensor:
        q, k, v = (split(part, self.heads) for part in (self.query(asking), self.key(x), self.value(x)))
        y = functional.scaled_dot_product_attention(q, k, v, attn_mask=seen)
        return self.out(y.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    def __init__(self, config: OctoConfig) -> None:
        super().__init__()
        self.LayerNorm_0, self.LayerNorm_1 = (nn.LayerNorm(config.width, _EPSILON) for _ in range(2))
        self.MultiHeadDotProductAttention_0 = _Attention(config.width, config.heads)
        self.MlpBlock_0 = nn.Module()
        self.MlpBlock_0.Dense_0 = nn.Linear(config.width, config.hidden)
        self.MlpBlock_0.Dense_1 = nn.Linear(config.hidden, config.width)

    def forward(self, x: Tensor, seen: Tensor, last: int) -> Tensor:
        """What becomes of the ``last`` tokens."""
        y = self.LayerNorm_0(x)
        x = x[:, -last:] + self.MultiHeadDotProductAttention_0(y[:, -last:], y, seen[:, None, -last:])
        inner = functional.gelu(self.MlpBlock_0.Dense_0(self.LayerNorm_1(x)), approximate="tanh")  # type: ignore[operator]
        return x + self.MlpBlock_0.Dense_1(inner)  # type: ignore[operator, no-any-return]


class _Transformer(nn.Module):
    """``octo_transformer``: what is observed to the readout of the last timestep, ``[B, E]``."""

    def __init__(self, config: OctoConfig) -> None:
        super().__init__()
        self.config, width, words = config, config.width, config.words
        for name, stem in config.stems.items():
            self.add_module(f"observation_tokenizers_{name}", _Stem(stem))
            self.add_module(f"obs_{name}_projection", nn.Linear(stem.out, width))
            self._position(f"obs_{name}", config.longest, stem.tokens)
        language = nn.Module()
        language.hf_model = T5(words)
        self.add_module(f"task_tokenizers_{words.name}", language)
        self.add_module(f"task_{words.name}_projection", nn.Linear(words.width, width))
        self._position(f"task_{words.name}", words.length)
        self._position(f"readout_{config.readout[0]}", config.longest, config.readout[1])
        self.BlockTransformer_0 = nn.Module()
        self.BlockTransformer_0.Transformer_0 = nn.Module()
        layers = self.BlockTransformer_0.Transformer_0
        for i in range(config.layers):
            layers.add_module(f"encoderblock_{i}", _Layer(config))
        layers.encoder_norm = nn.LayerNorm(width, _EPSILON)

    def _position(self, name: str, *sizes: int) -> None:
        shape = (1, *sizes, self.config.width)
        self.register_parameter(f"{name}_pos_embedding", nn.Parameter(torch.zeros(shape)))

    def _placed(self, name: str, tokens: Tensor) -> Tensor:
        projected: Tensor = self.get_submodule(f"{name}_projection")(tokens)
        position: Tensor = getattr(self, f"{name}_pos_embedding")
        return projected + (position if tokens.ndim == 3 else position[:, : self.config.window])

    def forward(self, observations: Mapping[str, Tensor], told: Sequence[Tensor], read: Sequence[Tensor]) -> Tensor:
        """Images ``[B, T, C, H, W]`` by key; tokens, mask and distances of words; and what ``attention`` gives."""
        config, window, (rules, times, always) = self.config, self.config.window, read
        known = self.get_submodule(f"task_tokenizers_{config.words.name}").hf_model(*told)  # type: ignore[operator]
        words = self._placed(f"task_{config.words.name}", known)
        groups = []
        for name, stem in config.stems.items():
            given = [(key, observations[key]) for key in stem.keys]
            images = torch.cat([each / 255 if key.startswith(DEPTH) else each for key, each in given], 2)
            seen = self.get_submodule(f"observation_tokenizers_{name}")(images)
            groups.append(self._placed(f"obs_{name}", seen))
        if config.repeated:
            groups.append(words[:, None].expand(-1, window, -1, -1))
        readout = getattr(self, f"readout_{config.readout[0]}_pos_embedding")[:, :window]
        groups.append(readout.expand(len(words), -1, -1, -1))
        x = torch.cat([words, torch.cat(groups, 2).flatten(1, 2)], 1)
        if PADDING in observations:
            rules = rules & (always | observations[PADDING][:, times])[:, None]
        layers: Any = self.BlockTransformer_0.Transformer_0
        for i in range(config.layers):
            last = x.shape[1] if i + 1 < config.layers else config.readout[1]
            x = layers.get_submodule(f"encoderblock_{i}")(x, rules, last)
        return layers.encoder_norm(x).mean(1)  # type: ignore[no-any-return]


def attention(config: OctoConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Which token reads which, ``[1, N, N]``; its timestep, ``[N]``; which are read even in one of padding, ``[N]``.

    Words read words; images those before, too; the readout itself, too.
    """
    groups, words = config.groups, config.words.length
    counts = np.cumsum([count for _, count in groups])
    side: Literal["left", "right"] = "right" if config.right else "left"
    told = [groups[place][0] for place in np.searchsorted(counts, np.arange(counts[-1]), side=side)]
    kinds = ["task"] * words + [name.partition("_")[0] for name in told] * config.window
    reads = {"task": ("task",), "obs": ("task", "obs"), "readout": ("task", "obs", "readout")}
    of_kind = torch.tensor([[other in reads[own] for other in kinds] for own in kinds])
    times = torch.arange(config.window).repeat_interleave(int(counts[-1]))
    since = torch.cat([torch.full((words,), -1), times])
    own = [name for name, count in groups for _ in range(count)]
    seen = [name.startswith("obs_") and not name.startswith("obs_task_") for name in own] * config.window
    always = ~torch.tensor([False] * words + seen)
    return (of_kind & (since[None] <= since[:, None]))[None], since.clamp(min=0), always


class _Perceptron(nn.Module):
    """Two layers with swish between."""

    def __init__(self, inputs: int, width: int, outputs: int, normed: bool = False) -> None:
        super().__init__()
        if normed:
            self.LayerNorm_0 = nn.LayerNorm(inputs, _EPSILON)
        self.Dense_0, self.Dense_1 = nn.Linear(inputs, width), nn.Linear(width, outputs)
        self.normed = normed

    def forward(self, x: Tensor) -> Tensor:
        x = self.LayerNorm_0(x) if self.normed else x
        return self.Dense_1(functional.silu(self.Dense_0(x)))  # type: ignore[no-any-return]


class _Waves(nn.Module):
    def __init__(self, count: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1, count // 2))

    def forward(self, timestep: Tensor) -> Tensor:
        angle = 2 * math.pi * timestep[:, None].float() @ self.weight
        return torch.cat([angle.cos(), angle.sin()], -1)


class _Score(nn.Module):
    """``diffusion_model``: residual blocks of one token, which time and readout enter with the actions.

    What is to be added to the noise goes through beside the token, so that nothing leads around the blocks.
    """

    def __init__(self, config: OctoConfig) -> None:
        super().__init__()
        head, size = config.head, config.head.horizon * config.head.actions
        self.sizes, self.blocks = [head.waves, config.width, size], head.blocks
        self.time_preprocess = _Waves(head.waves)
        self.cond_encoder = _Perceptron(head.waves, 2 * head.waves, head.waves)
        self.reverse_network = nn.Module()
        self.reverse_network.Dense_0 = nn.Linear(sum(self.sizes), head.width)
        for i in range(head.blocks):
            self.reverse_network.add_module(
                f"MLPResNetBlock_{i}", _Perceptron(head.width, 4 * head.width, head.width, True)
            )
        self.reverse_network.Dense_1 = nn.Linear(head.width, size)

    def forward(self, actions: Tensor, timestep: Tensor, readout: Tensor, added: Tensor) -> Tensor:
        """``[B, S]``, ``[B]`` and ``[B, E]`` to noise ``[B, S]``, and what is added to it."""
        network = self.reverse_network
        parts = network.Dense_0.weight.split(self.sizes, 1)  # type: ignore[union-attr, operator]
        read = (self.cond_encoder(self.time_preprocess(timestep)), readout, actions)
        time, seen, own = (functional.linear(one, part) for one, part in zip(read, parts, strict=True))
        x = own + (time + seen + network.Dense_0.bias)  # type: ignore[union-attr, operator]
        x, width = torch.cat([x, added], 1), x.shape[1]
        for i in range(self.blocks):
            x = x + functional.pad(network.get_submodule(f"MLPResNetBlock_{i}")(x[:, :width]), (0, self.sizes[-1]))
        return network.Dense_1(functional.silu(x[:, :width])) + x[:, width:]  # type: ignore[operator, no-any-return]


class Octo(nn.Module):
    """All parameters; ``OctoObserved`` and ``OctoDenoiser`` evaluate them."""

    def __init__(self, config: OctoConfig) -> None:
        super().__init__()
        self.octo_transformer = _Transformer(config)
        self.heads_action = nn.Module()
        self.heads_action.diffusion_model = _Score(config)


class OctoObserved(nn.Module):
    """What the original evaluates once a call.

    Args:
        task: tokens and their mask of the one instruction that is compiled in; None where they are observed.
    """

    rules: Tensor
    times: Tensor
    always: Tensor
    distances: Tensor

    def __init__(self, network: Octo, config: OctoConfig, task: tuple[Tensor, Tensor] | None) -> None:
        super().__init__()
        self.network = network.octo_transformer
        for name, value in zip(("rules", "times", "always"), attention(config), strict=True):
            self.register_buffer(name, value, persistent=False)
        words = config.words
        self.register_buffer("distances", word_distances(words.length, words.buckets), persistent=False)
        self.told = task is not None
        for name, value in zip(("tokens", "mask"), task or (), strict=False):
            self.register_buffer(name, value, persistent=False)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """Observations by argument to the readout."""
        if self.told:
            count = len(next(iter(observations.values())))
            tokens, mask = (self.get_buffer(name).expand(count, -1) for name in ("tokens", "mask"))
        else:
            tokens, mask = (observations[key.replace(".", "_")] for key in (TOKENS, MASK))
        return self.network(observations, (tokens, mask, self.distances), (self.rules, self.times, self.always))  # type: ignore[no-any-return]


class OctoDenoiser(nn.Module):
    """One step. It predicts the noise of the sample as it is given, which the original clips after every step.

    Here nothing is clipped before the sample is read, so the noise is that of the clipped sample, and what was cut off.

    Args:
        signal: share of the actions in the variance of a sample at each timestep, float32 ``[K]``.
    """

    deviation: Tensor
    limit: Tensor

    def __init__(self, network: Octo, config: OctoConfig, signal: Sequence[float]) -> None:
        super().__init__()
        self.score = network.heads_action.diffusion_model
        self.register_buffer("deviation", torch.sqrt(1 - torch.tensor(signal)), persistent=False)
        limit = torch.full((config.head.steps,), config.head.bound)
        limit[-1] = torch.finfo(torch.float32).max  # nothing has clipped the noise that the loop begins with
        self.register_buffer("limit", limit, persistent=False)

    def forward(self, sample: Tensor, timestep: Tensor, readout: Tensor) -> Tensor:
        """``[B, T, D]``, int64 ``[B]`` and ``[B, E]`` -> ``[B, T, D]``."""
        x = sample.flatten(1)
        limit = self.limit[timestep][:, None]
        kept = torch.minimum(torch.maximum(x, -limit), limit)
        noise = self.score(kept, timestep, readout, (x - kept) / self.deviation[timestep][:, None])  # type: ignore[operator]
        return noise.unflatten(1, tuple(sample.shape[1:]))  # type: ignore[no-any-return]
