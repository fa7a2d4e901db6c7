"""Evo-1's action head: actions look at what the language model made of cameras and instruction, and at the state.

An attribute's name is that of lerobot's weights, but for those that ``lerobot.evo1`` renames.

Sources: Lin et al., Evo-1 (arXiv 2511.04555); ``lerobot.policies.evo1`` of huggingface/lerobot 0.6; and
``Evo_1/model`` of MINT-SJTU/Evo-1 at 1bf31c4.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .internvl import InternVL, InternVLConfig, Prompt
from .language_layers import added

TIMES = 1000
"""Rows of the timestep's embedding."""


@dataclass(frozen=True)
class Evo1Config:
    """Sizes and variant; the names are those of lerobot's configuration.

    Attributes:
        chunk_size: actions of a chunk.
        actions: numbers of an action that the robot has; the others, up to ``max_action_dim``, are zeros.
        hidden_dim: width inside of what gives the actions.
        state_hidden_dim: width inside of what reads the state.
        return_cls_only: whether the head reads the last word's feature alone.
    """

    language: InternVLConfig
    chunk_size: int
    actions: int
    max_action_dim: int
    max_state_dim: int
    hidden_dim: int
    state_hidden_dim: int
    num_heads: int
    num_layers: int
    return_cls_only: bool

    @property
    def width(self) -> int:
        """Of the head, and of the language model."""
        return self.language.text.width


class Perceptron(nn.Module):
    """Two layers."""

    def __init__(self, before: int, inside: int, after: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(before, inside), nn.Linear(inside, after)

    def forward(self, x: Tensor) -> Tensor:
        """``[..., before]`` -> ``[..., after]``."""
        return self.fc2(torch.relu(self.fc1(x)))  # type: ignore[no-any-return]


class _ActionEncoder(nn.Module):
    """Actions to tokens, each with its place in the chunk."""

    places: Tensor

    def __init__(self, config: Evo1Config) -> None:
        super().__init__()
        width = config.width
        self.first, self.second = nn.Linear(config.max_action_dim, width), nn.Linear(width, width)
        self.third = nn.Linear(width, width)
        self.register_buffer("places", torch.zeros(1, config.chunk_size, width))

    def forward(self, actions: Tensor) -> Tensor:
        placed = torch.relu(self.first(actions)) + self.places
        return self.third(torch.relu(self.second(placed)))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    """Attention to the context, and feed-forward, which the timestep is added before."""

    def __init__(self, config: Evo1Config) -> None:
        super().__init__()
        width = config.width
        self.attn = nn.MultiheadAttention(width, config.num_heads, batch_first=True)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.ff = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, context: Tensor, hidden: Tensor | None, time: Tensor) -> Tensor:
        looked = self.attn(self.norm1(x), context, context, key_padding_mask=hidden, need_weights=False)[0]
        x = x + looked
        return x + self.ff(self.norm2(x) + time)  # type: ignore[no-any-return]


class _Head(nn.Module):
    times: Tensor

    def __init__(self, config: Evo1Config) -> None:
        super().__init__()
        width, several = config.width, config.chunk_size > 1
        self.register_buffer("times", torch.zeros(1, TIMES, width))
        self.transformer_blocks = nn.ModuleList(_Layer(config) for _ in range(config.num_layers))
        self.norm_out = nn.LayerNorm(width)
        self.seq_pool_proj = nn.Linear(config.chunk_size * width, width) if several else nn.Identity()
        self.mlp_head = Perceptron(width, config.hidden_dim, config.chunk_size * config.max_action_dim)
        self.state_encoder = Perceptron(config.max_state_dim, config.state_hidden_dim, width)
        self.action_encoder = _ActionEncoder(config) if several else nn.Linear(config.max_action_dim, width)


class Evo1(nn.Module):
    """The whole network."""

    def __init__(self, config: Evo1Config, prompt: Prompt) -> None:
        super().__init__()
        self.config = config
        self.embedder, self.action_head = InternVL(config.language, prompt), _Head(config)


class Prefix(nn.Module):
    """What the network reads once a call."""

    def __init__(self, network: Evo1) -> None:
        super().__init__()
        self.embedder, self.state_encoder = network.embedder, network.action_head.state_encoder
        self.last_only = network.config.return_cls_only

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """The context ``[B, S, width]``; and what is added to scores, ``[B, S]``, unless it has no padding.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``.
            state: padded ``[B, Ds]``.
        """
        features, valid = self.embedder(images, tokens, mask)
        own = self.state_encoder(state)[:, None]
        if not self.last_only:
            return torch.cat([features, own], 1), added(functional.pad(valid, (0, 1), value=True))
        last = (valid.sum(-1) - 1)[:, None, None].expand(-1, 1, features.shape[2])
        return (torch.cat([torch.gather(features, 1, last), own], 1),)


class PaddedPrefix(nn.Module):
    """The same as its authors' code has it, whose head looks at what the language model does not attend to, too.

    All padding has one feature: it stands there once, and the logarithm of how often is added to its scores.

    Args:
        pictures: what makes of the robot's pictures those that the network sees.
        left_out: ``[n, width]``, the feature of the padding, and then those of a black picture.
        padding: tokens of padding that the instruction is without.
        black: so many pictures are black.
    """

    left_out: Tensor
    repeated: Tensor

    def __init__(self, network: Evo1, pictures: nn.Module, left_out: Tensor, padding: int, black: int) -> None:
        super().__init__()
        self.embedder, self.state_encoder = network.embedder, network.action_head.state_encoder
        self.pictures, self.padding = pictures, padding
        self.register_buffer("left_out", left_out, persistent=False)
        repeated = torch.full((len(left_out) - 1,), float(max(black, 1)), device="cpu").log()
        self.register_buffer("repeated", functional.pad(repeated, (0, 1)), persistent=False)  # the state stands last

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """See ``Prefix``."""
        features, valid = self.embedder(self.pictures(images), tokens, mask)
        own, many = self.state_encoder(state)[:, None], len(features)
        count = self.padding + mask.logical_not().sum(1, keepdim=True)
        padded = count.clamp(min=1).to(torch.float32).log() + added(count > 0)
        context = torch.cat([features, self.left_out.expand(many, -1, -1), own], 1)
        return context, torch.cat([added(valid), padded, self.repeated.expand(many, -1)], 1)


class Denoiser(nn.Module):
    """The head."""

    def __init__(self, network: Evo1) -> None:
        super().__init__()
        self.config, self.head = network.config, network.action_head

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, rows of the timestep's embedding ``[B]``, what ``Prefix`` gives -> velocity ``[B, T, D]``."""
        head, config = self.head, self.config
        context, hidden = (*encoded, None)[:2]
        rest = config.max_action_dim - config.actions
        x = head.action_encoder(functional.pad(sample[..., : config.actions], (0, rest)))
        time = head.times[0][timestep][:, None]
        for layer in head.transformer_blocks:
            x = layer(x, context, hidden, time)
        pooled = head.seq_pool_proj(head.norm_out(x).flatten(1))
        made = head.mlp_head(pooled).unflatten(1, (config.chunk_size, config.max_action_dim))
        return functional.pad(made[..., : config.actions], (0, rest))
