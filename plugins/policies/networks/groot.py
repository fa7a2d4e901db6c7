"""GR00T N1.7's action head: actions and state look at what the language model made of cameras and words, by turns.

VLA-JEPA's is built like it. An attribute's name is that of lerobot's weights, but for those that ``lerobot.groot`` or
``lerobot.vla_jepa`` renames. Of weights that each embodiment has, there are those of one.

Sources: Bjorck et al., GR00T N1 (arXiv 2503.14734); ``lerobot.policies.groot`` and ``.vla_jepa`` of huggingface/lerobot
0.6.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .clip import Attention, FeedForward, Layers, TowerConfig
from .evo1 import Perceptron
from .internvl import Prompt
from .language_layers import added, angles
from .qwen3_vl import Qwen3VL, Qwen3VLConfig

_WAVES = 256
"""Channels of a timestep before it is embedded."""


@dataclass(frozen=True)
class GrootConfig:
    """Sizes and variant.

    Attributes:
        mixing: layers that mix the language model's features before the head looks at them; None for none.
        normed: whether these features are normalised first.
        layers: of the head: width, heads, and width inside the feed-forward layers.
        out: width of what gives the actions.
        state: numbers of the state, padded; 0 without one.
        actions: numbers of an action, padded.
        horizon: actions that are denoised.
        places: rows of the embedding of an action's place in the chunk; None without one.
        looks: what each layer looks at: ``itself``, state and actions alone, or features of ``words`` or ``images``.
        apart: whether those of words are without those of images.
        read: of the features, the last so many are looked at, and no others; 0 for all.
        queries: tokens of the head's own, between state and actions.
    """

    language: Qwen3VLConfig
    mixing: TowerConfig | None
    normed: bool
    layers: TowerConfig
    out: int
    state: int
    actions: int
    horizon: int
    places: int | None
    looks: tuple[str, ...]
    apart: bool
    read: int = 0
    queries: int = 0


class _ActionEncoder(nn.Module):
    """Actions and their timestep to tokens."""

    def __init__(self, actions: int, width: int) -> None:
        super().__init__()
        self.W1, self.W2 = nn.Linear(actions, width), nn.Linear(2 * width, width)
        self.W3 = nn.Linear(width, width)

    def forward(self, actions: Tensor, timestep: Tensor) -> Tensor:
        x = self.W1(actions)
        half = x.shape[-1] // 2
        angle = angles(timestep, half, half)
        time = torch.cat([angle.sin(), angle.cos()], -1)[:, None].expand_as(x)
        return self.W3(functional.silu(self.W2(torch.cat([x, time], -1))))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    """Attention, to features or to itself, that the timestep shifts and scales before; and feed-forward."""

    def __init__(self, config: TowerConfig, source: int | None) -> None:
        super().__init__()
        width = config.hidden_size
        self.scale = nn.Linear(width, 2 * width)
        self.attn1, self.ff = Attention(width, config.num_attention_heads, source), FeedForward(config)
        self.epsilon = config.layer_norm_eps

    def forward(self, x: Tensor, memory: Tensor | None, mask: Tensor | None, time: Tensor) -> Tensor:
        scale, shift = self.scale(functional.silu(time))[:, None].chunk(2, -1)
        moved = functional.layer_norm(x, x.shape[-1:], eps=self.epsilon) * (1 + scale) + shift
        x = x + self.attn1(moved, moved if memory is None else memory, mask)
        return x + self.ff(functional.layer_norm(x, x.shape[-1:], eps=self.epsilon))  # type: ignore[no-any-return]


class _DiT(nn.Module):
    def __init__(self, config: GrootConfig) -> None:
        super().__init__()
        width, source = config.layers.hidden_size, config.language.text.width
        self.timestep_encoder: Any = nn.Module()
        self.timestep_encoder.linear_1 = nn.Linear(_WAVES, width)
        self.timestep_encoder.linear_2 = nn.Linear(width, width)
        sources = (None if look == "itself" else source for look in config.looks)
        self.transformer_blocks = nn.ModuleList(_Layer(config.layers, each) for each in sources)
        self.proj_out_1, self.proj_out_2 = nn.Linear(width, 2 * width), nn.Linear(width, config.out)


class _Head(nn.Module):
    def __init__(self, config: GrootConfig) -> None:
        super().__init__()
        width, source, inside = config.layers.hidden_size, config.language.text.width, config.out
        self.state_encoder = Perceptron(config.state, inside, width) if config.state else None
        self.action_encoder = _ActionEncoder(config.actions, width)
        self.action_decoder = Perceptron(inside, inside, config.actions)
        self.vlln = nn.LayerNorm(source) if config.normed else nn.Identity()
        self.vl_self_attention = Layers(config.mixing) if config.mixing else None
        self.position_embedding = nn.Embedding(config.places, width) if config.places else None
        self.future_tokens = nn.Embedding(config.queries, width) if config.queries else None
        self.model = _DiT(config)


class Groot(nn.Module):
    """The whole network."""

    def __init__(self, config: GrootConfig, prompt: Prompt) -> None:
        super().__init__()
        self.config = config
        self.backbone, self.action_head = Qwen3VL(config.language, prompt), _Head(config)


class Prefix(nn.Module):
    """What the network reads once a call; ``seen`` makes of all images what the backbone sees of them."""

    def __init__(self, network: Groot, seen: nn.Module) -> None:
        super().__init__()
        head, self.seen = network.action_head, seen
        self.backbone, self.norm, self.mixing = network.backbone, head.vlln, head.vl_self_attention
        self.state_encoder, self.config = head.state_encoder, network.config

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor | None) -> tuple[Tensor, ...]:
        """The state's token ``[B, 1, E]``; what is added to scores, ``[B, 1, 1, W]``; and the features it is of.

        These are of words ``[B, W, width]`` and then those of images, where they are looked at by turns. Without a
        state there is no token of it, and nothing is added where the last features alone are read. ``state`` is padded,
        ``[B, Ds]``; the others are those of ``Qwen3VL``.
        """
        features, valid = self.backbone(self.seen(images), tokens, mask)
        features, read = self.norm(features), self.config.read
        own = () if self.state_encoder is None else (self.state_encoder(state)[:, None],)
        if self.mixing is not None:
            features = self.mixing(features, added(valid[:, None, None, :]))
        if read:
            return *own, features[:, -read:]
        if not self.config.apart:
            return *own, added(valid)[:, None, None], features
        pictured = self.backbone.pictured + [False] * tokens.shape[1]
        words, pictures = (
            torch.tensor([i for i, each in enumerate(pictured) if each is of], device=mask.device)
            for of in (False, True)
        )
        return *own, added(valid[:, words])[:, None, None], features[:, words], features[:, pictures]


class Denoiser(nn.Module):
    """The head."""

    def __init__(self, network: Groot) -> None:
        super().__init__()
        self.config, self.head = network.config, network.action_head

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, timesteps int64 ``[B]`` and what ``Prefix`` gives -> velocity ``[B, T, D]``."""
        head, left = self.head, list(encoded)
        own = [left.pop(0)] if self.config.state else []
        hidden = None if self.config.read else left.pop(0)
        words, *pictures = left
        clock, count = timestep.to(torch.float32), sample.shape[1]
        angle = angles(clock, _WAVES // 2, _WAVES // 2 - 1)
        made, model = torch.cat([angle.cos(), angle.sin()], -1), head.model
        time = model.timestep_encoder.linear_2(functional.silu(model.timestep_encoder.linear_1(made)))
        x = head.action_encoder(sample, clock)
        if head.position_embedding is not None:
            x = x + head.position_embedding.weight[:count]
        if head.future_tokens is not None:
            own.append(head.future_tokens.weight.expand(len(x), -1, -1))
        x = torch.cat([*own, x], 1)
        seen: Any = {"itself": (None, None), "words": (words, hidden), "images": (*pictures, None)}
        for look, layer in zip(self.config.looks, model.transformer_blocks, strict=True):
            x = layer(x, *seen[look], time)
        shift, scale = model.proj_out_1(functional.silu(time))[:, None].chunk(2, -1)
        x = functional.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift
        return head.action_decoder(model.proj_out_2(x[:, -count:]))  # type: ignore[no-any-return]
