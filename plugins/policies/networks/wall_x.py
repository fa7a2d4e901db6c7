"""Wall-X: noisy actions become tokens after a prompt, which Qwen2.5-VL reads with an expert of their own.

Attention and norms of the language model are the same for all tokens; of the feed-forward layers one is for the prompt
and another for actions. No token of the prompt sees an action, so it is read once a call.

An attribute's name is that of lerobot's weights, but for what ``lerobot.wall_x`` renames.

Sources: Zhai et al., Igniting VLMs toward the Embodied Space (arXiv 2509.11766); ``lerobot.policies.wall_x`` of
huggingface/lerobot 0.6.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from . import language_layers as layers
from .qwen25_vl import Piece, Qwen25VL, Qwen25VLConfig, Read


@dataclass(frozen=True)
class WallXConfig:
    """Sizes and variant.

    Attributes:
        expert: feed-forward layers of actions; its width is how many numbers of a token they read and write, the first
            ones. None where the prompt's are for actions, too.
        given: numbers of the robot's state, of ``state`` with padding.
        moved: numbers of the robot's action, of ``actions`` with padding.
    """

    language: Qwen25VLConfig
    expert: layers.LanguageConfig | None
    given: int
    state: int
    moved: int
    actions: int


class Expert(layers.FeedForward):
    """Feed-forward layers that read and write the first ``config.width`` numbers of a token."""

    def __init__(self, config: layers.LanguageConfig) -> None:
        super().__init__(config)
        self.width = config.width

    def forward(self, x: Tensor) -> Tensor:
        """``[..., width]`` -> the same."""
        return functional.pad(super().forward(x[..., : self.width]), (0, x.shape[-1] - self.width))


class WallX(nn.Module):
    """The whole network."""

    def __init__(self, config: WallXConfig, prompt: Sequence[Piece]) -> None:
        super().__init__()
        self.config, text = config, config.language.text
        self.backbone = Qwen25VL(config.language, prompt)
        self.experts = nn.ModuleList()
        if (own := config.expert) is not None:
            kind = layers.FeedForward if own.width == text.width else Expert
            self.experts.extend(kind(own) for _ in range(text.layers))
        self.propri_proj = nn.Linear(2 * config.state, text.width, bias=False)
        self.w1 = nn.Linear(2 * config.actions, text.width, bias=False)
        self.w2 = nn.Linear(2 * text.width, text.width, bias=False)
        self.w3 = nn.Linear(text.width, text.width, bias=False)
        self.action_proj_back = nn.Linear(text.width, config.actions, bias=False)


class Prefix(nn.Module):
    """What the network reads once a call; ``seen`` makes of all images what the vision transformer sees of them."""

    def __init__(self, network: WallX, seen: nn.Module) -> None:
        super().__init__()
        self.seen, self.backbone, self.propri_proj = seen, network.backbone, network.propri_proj
        self.given = network.config.given

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """What ``Denoiser`` takes; ``state`` is padded, ``[B, Ds]``, and the others are those of ``Qwen25VL.read``."""
        own = self.propri_proj(_marked(state, self.given))
        valid, after, cache = self.backbone.read(self.seen(images), tokens, mask, own)
        return valid, after, *cache


class _Acting(layers.Layer):
    """A layer as it reads actions: attention and norms are those of the layer that reads the prompt."""

    def __init__(self, layer: layers.Layer, expert: layers.FeedForward) -> None:
        nn.Module.__init__(self)
        self.input_layernorm, self.post_attention_layernorm = layer.input_layernorm, layer.post_attention_layernorm
        self.self_attn, self.mlp = layer.self_attn, expert


class Denoiser(nn.Module):
    """The language model as it reads actions, each of which sees the prompt and all actions."""

    def __init__(self, network: WallX) -> None:
        super().__init__()
        self.backbone, self.moved = network.backbone, network.config.moved
        own: list[Any] = list(network.backbone.language_model.layers)
        experts: list[Any] = list(network.experts) or [layer.mlp for layer in own]
        self.layers = nn.ModuleList(_Acting(*pair) for pair in zip(own, experts, strict=True))
        self.w1, self.w2, self.w3 = network.w1, network.w2, network.w3
        self.action_proj_back = network.action_proj_back

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 0 to 1 and what ``Prefix`` gives -> the velocity ``[B, T, D]``."""
        valid, after, *cache = encoded
        actions = self.w1(_marked(sample, self.moved))
        half = actions.shape[-1] // 2
        angles = layers.angles(timestep, half, half - 1)
        time = torch.cat([angles.sin(), angles.cos()], -1)[:, None].expand_as(actions)
        x = self.w3(functional.silu(self.w2(torch.cat([actions, time], 2))))
        everyone = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool, device=x.device)
        answers = self.backbone.answered(x, Read(valid, after, tuple(cache)), everyone, self.layers)
        return self.action_proj_back(answers)  # type: ignore[no-any-return]


def _marked(x: Tensor, own: int) -> Tensor:
    """Numbers ``[..., n]`` and, beside them, 1 for each that the robot has, and 0 for padding: ``[..., 2 n]``."""
    there = torch.arange(x.shape[-1], device=x.device) < own
    return torch.cat([x, there.to(x.dtype).expand_as(x)], -1)
