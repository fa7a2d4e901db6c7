"""X-VLA: a transformer on the tokens of actions, images, words, and prompts that each robot has of its own.

An attribute's name is that of lerobot's weights, but for those that ``lerobot.xvla`` renames.

Sources: Zheng et al., X-VLA (arXiv 2510.10274); ``lerobot.policies.xvla`` of huggingface/lerobot 0.6.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .clip import Layers, TowerConfig
from .florence import Florence, FlorenceConfig
from .language_layers import angles

_LONGEST_PERIOD = 100


@dataclass(frozen=True)
class XVLAConfig:
    """Sizes and variant.

    Attributes:
        layers: of the transformer on all tokens.
        chunk_size: actions of a chunk.
        actions: numbers of an action, those counted that the robot has none of.
        grippers: of these, what opens and closes: the network gives a logit, and is never told the number.
        state: numbers of the padded state; 0 without one.
        time: width of the timestep's embedding.
        prompts: tokens of the robot's own.
        positions: tokens that have an embedding.
        views: images, those counted that the robot has none of: their tokens are zeros.
        padding: the token after the end of an instruction, which is read, too.
    """

    florence: FlorenceConfig
    layers: TowerConfig
    chunk_size: int
    actions: int
    grippers: tuple[int, ...]
    state: int
    time: int
    prompts: int
    positions: int
    views: int
    padding: int


class _Transformer(nn.Module):
    def __init__(self, config: XVLAConfig) -> None:
        super().__init__()
        width, features = config.layers.hidden_size, config.florence.text.hidden_size
        self.blocks = Layers(config.layers)
        self.vlm_proj, self.aux_visual_proj = nn.Linear(features, width), nn.Linear(features, width)
        self.pos_emb = nn.Parameter(torch.zeros(1, config.positions, width))
        self.norm = nn.LayerNorm(width)
        self.action_encoder = nn.Linear(config.actions + config.state + config.time, width)
        self.action_decoder = nn.Linear(width, config.actions)
        if config.prompts:
            self.soft_prompts = nn.Parameter(torch.zeros(config.prompts * width))


class XVLA(nn.Module):
    """The whole network, of one robot."""

    def __init__(self, config: XVLAConfig) -> None:
        super().__init__()
        self.config = config
        self.vlm, self.transformer = Florence(config.florence), _Transformer(config)


class Prefix(nn.Module):
    """What the network reads once a call."""

    def __init__(self, network: XVLA) -> None:
        super().__init__()
        self.config, self.vlm, self.transformer = network.config, network.vlm, network.transformer

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor | None) -> tuple[Tensor, ...]:
        """The tokens beside those of actions ``[B, S, width]``; and the state, if there is one.

        Args:
            images: of each camera ``[B, 3, H, W]``, in -1..1.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``.
            state: padded ``[B, Ds]``.
        """
        config, own = self.config, self.transformer
        words, others = self.vlm(images, torch.where(mask, tokens, config.padding))
        others = functional.pad(others, (0, 0, 0, 0, 0, config.views - len(images))).flatten(1, 2)
        parts = [own.vlm_proj(words), own.aux_visual_proj(others)] if config.views > 1 else [own.vlm_proj(words)]
        context = torch.cat(parts, 1)
        context = context + own.pos_emb[:, config.chunk_size : config.chunk_size + context.shape[1]]
        if config.prompts:
            prompts = own.soft_prompts.view(1, config.prompts, -1).expand(len(context), -1, -1)
            context = torch.cat([context, prompts], 1)
        return (context,) if state is None else (context, state)


class Denoiser(nn.Module):
    """The transformer."""

    def __init__(self, network: XVLA) -> None:
        super().__init__()
        self.config, self.transformer = network.config, network.transformer
        self.grippers = [channel in network.config.grippers for channel in range(network.config.actions)]

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """``[B, T, D]``, times ``[B]`` from 1 to 0, what ``Prefix`` gives -> the actions ``[B, T, D]``.

        The network reads no number of a gripper, so one that is made a probability at every step is what lerobot makes
        of the last.
        """
        own, (context, *state) = self.transformer, encoded
        count = self.config.chunk_size
        beside = torch.cat([*state, _waves(timestep, self.config.time)], 1)[:, None].expand(-1, count, -1)
        x = own.action_encoder(torch.cat([sample, beside], 2)) + own.pos_emb[:, :count]
        x = own.blocks(torch.cat([x, context], 1))
        actions: Tensor = own.action_decoder(own.norm(x[:, :count]))
        if not any(self.grippers):
            return actions
        return torch.where(torch.tensor(self.grippers, device=actions.device), actions.sigmoid(), actions)


def _waves(timestep: Tensor, width: int) -> Tensor:
    """Cosine and sine of a time ``[B]``, ``[B, width]``; an odd width ends with a zero."""
    half = width // 2
    angle = angles(timestep, half, half, _LONGEST_PERIOD)
    return functional.pad(torch.cat([angle.cos(), angle.sin()], -1), (0, width % 2))
