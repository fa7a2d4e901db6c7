"""EO-1: noisy actions become tokens after a prompt, which Qwen2.5-VL reads them with; its answers are the velocity.

An attribute's name is that of lerobot's weights, but for what ``lerobot.eo1`` renames.

Sources: Qu et al., EO-1 (arXiv 2508.21112); ``lerobot.policies.eo1`` of huggingface/lerobot 0.6.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .language_layers import waves
from .qwen25_vl import Piece, Qwen25VL, Qwen25VLConfig, Read

ACTIVATIONS: Mapping[str, Callable[[], nn.Module]] = {
    "linear": nn.Identity,
    "gelu": nn.GELU,
    "gelu_pytorch_tanh": lambda: nn.GELU("tanh"),
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "swish": nn.SiLU,
    "tanh": nn.Tanh,
}
"""By the names of transformers."""


@dataclass(frozen=True)
class EO1Config:
    """Sizes and variant.

    Attributes:
        state: numbers of the state, padded.
        actions: numbers of an action, padded.
        layers: that make actions of what the language model answers.
        activation: between these.
        periods: shortest and longest of the timestep's waves.
    """

    language: Qwen25VLConfig
    state: int
    actions: int
    layers: int
    activation: str
    periods: tuple[float, float]


class EO1(nn.Module):
    """The whole network."""

    def __init__(self, config: EO1Config, prompt: Sequence[Piece]) -> None:
        super().__init__()
        self.config, width = config, config.language.text.width
        self.backbone = Qwen25VL(config.language, prompt)
        self.state_proj, self.action_in_proj = nn.Linear(config.state, width), nn.Linear(config.actions, width)
        self.action_time_mlp_in, self.action_time_mlp_out = nn.Linear(2 * width, width), nn.Linear(width, width)
        out = list[nn.Module]()
        for _ in range(config.layers - 1):
            out += [nn.Linear(width, width), ACTIVATIONS[config.activation]()]
        self.action_out_proj = nn.Sequential(*out, nn.Linear(width, config.actions))


class Prefix(nn.Module):
    """What the network reads once a call; ``seen`` makes of all images what the vision transformer sees of them."""

    def __init__(self, network: EO1, seen: nn.Module) -> None:
        super().__init__()
        self.seen, self.backbone, self.state_proj = seen, network.backbone, network.state_proj

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """What ``Denoiser`` takes; ``state`` is padded, ``[B, Ds]``, and the others are those of ``Qwen25VL.read``."""
        valid, after, cache = self.backbone.read(self.seen(images), tokens, mask, self.state_proj(state))
        return valid, after, *cache


class Denoiser(nn.Module):
    """The language model as it reads actions."""

    def __init__(self, network: EO1) -> None:
        super().__init__()
        self.backbone, self.config = network.backbone, network.config
        self.action_in_proj, self.action_out_proj = network.action_in_proj, network.action_out_proj
        self.mlp_in, self.mlp_out = network.action_time_mlp_in, network.action_time_mlp_out

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 1 to 0 and what ``Prefix`` gives -> the velocity ``[B, T, D]``."""
        valid, after, *cache = encoded
        actions = self.action_in_proj(sample)
        time = waves(timestep, actions.shape[-1], *self.config.periods)[:, None].expand_as(actions)
        x = self.mlp_out(functional.silu(self.mlp_in(torch.cat([actions, time], 2))))
        earlier = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool, device=x.device).tril()
        answers = self.backbone.answered(x, Read(valid, after, tuple(cache)), earlier)
        return self.action_out_proj(answers)  # type: ignore[no-any-return]
