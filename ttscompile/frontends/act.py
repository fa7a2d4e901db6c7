"""ACT, the Action Chunking Transformer, rebuilt: images, state and learned queries to a chunk of actions in one pass.

Written from the description of the network, with attribute names under which the weights that lerobot saves load as
they are. The encoder of a variational autoencoder, with which it is trained, is not: a robot's latent is zeros.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (arXiv 2304.13705), as in
``lerobot.policies.act`` of huggingface/lerobot 0.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .resnet import CHANNELS, SHRINKS, resnet


@dataclass(frozen=True)
class ACTConfig:
    """Sizes and variant of the network; the names are those of lerobot's configuration.

    Attributes:
        state: width of the robot's state; None for none.
        environment: the same of the environment's.
        cameras: height and width of each camera's images.
        pre_norm: whether a block's input is normalised, rather than the stream after it.
    """

    chunk_size: int
    action_dim: int
    state: int | None
    environment: int | None
    cameras: tuple[tuple[int, int], ...]
    vision_backbone: str
    dim_model: int
    n_heads: int
    dim_feedforward: int
    n_encoder_layers: int
    n_decoder_layers: int
    latent_dim: int
    gelu: bool
    pre_norm: bool


class _Layer(nn.Module):
    """Self-attention, in a decoder attention to the encoder's tokens, and feed-forward, each a residual."""

    def __init__(self, config: ACTConfig, decodes: bool) -> None:
        super().__init__()
        width, inner = config.dim_model, config.dim_feedforward
        self.pre_norm, self.gelu = config.pre_norm, config.gelu
        self.self_attn = nn.MultiheadAttention(width, config.n_heads, batch_first=True)
        self.multihead_attn = nn.MultiheadAttention(width, config.n_heads, batch_first=True) if decodes else None
        self.linear1, self.linear2 = nn.Linear(width, inner), nn.Linear(inner, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.norm3 = nn.LayerNorm(width) if decodes else None

    def forward(self, x: Tensor, places: Tensor, memory: Tensor | None = None, at: Tensor | None = None) -> Tensor:
        """Tokens ``[B, T, width]`` and their positions; the encoder's tokens ``[B, S, width]`` without and with theirs."""
        read = self._before(x, self.norm1)
        mixed, _ = self.self_attn(read + places, read + places, read, need_weights=False)
        x, last = self._after(x + mixed, self.norm1), self.norm2
        if self.multihead_attn is not None and self.norm3 is not None:
            query, last = self._before(x, self.norm2) + places, self.norm3
            mixed, _ = self.multihead_attn(query, at, memory, need_weights=False)
            x = self._after(x + mixed, self.norm2)
        inner = self.linear1(self._before(x, last))
        return self._after(x + self.linear2(functional.gelu(inner) if self.gelu else inner.relu()), last)

    def _before(self, x: Tensor, norm: nn.Module) -> Tensor:
        return norm(x) if self.pre_norm else x  # type: ignore[no-any-return]

    def _after(self, x: Tensor, norm: nn.Module) -> Tensor:
        return x if self.pre_norm else norm(x)  # type: ignore[no-any-return]


class _Layers(nn.Module):
    def __init__(self, config: ACTConfig, count: int, decodes: bool) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(config, decodes) for _ in range(count))
        self.norm = nn.LayerNorm(config.dim_model) if decodes or config.pre_norm else nn.Identity()

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        for layer in self.layers:
            x = layer(x, *others)
        return self.norm(x)  # type: ignore[no-any-return]


class ACT(nn.Module):
    """The network. Its tokens are [latent, state, environment, each camera's features, pixel by pixel]."""

    def __init__(self, config: ACTConfig) -> None:
        super().__init__()
        width, vectors = config.dim_model, 1
        self.encoder_latent_input_proj = nn.Linear(config.latent_dim, width)
        for name, size in (("robot", config.state), ("env", config.environment)):
            if size is not None:
                self.add_module(f"encoder_{name}_state_input_proj", nn.Linear(size, width))
                vectors += 1
        self.encoder_1d_feature_pos_embed = nn.Embedding(vectors, width)
        if config.cameras:
            # Frozen batch norm, as lerobot has it, is batch norm that is not trained.
            self.backbone = resnet(3, nn.BatchNorm2d, config.vision_backbone)
            self.encoder_img_feat_input_proj = nn.Conv2d(CHANNELS, width, 1)
        for number, size in enumerate(config.cameras):
            rows, columns = (math.ceil(n / SHRINKS) for n in size)
            self.register_buffer(f"pixels{number}", positions_2d(rows, columns, width), persistent=False)
        self.encoder = _Layers(config, config.n_encoder_layers, decodes=False)
        self.decoder = _Layers(config, config.n_decoder_layers, decodes=True)
        self.decoder_pos_embed = nn.Embedding(config.chunk_size, width)
        self.action_head = nn.Linear(width, config.action_dim)

    def forward(self, state: Tensor | None, environment: Tensor | None, images: Sequence[Tensor]) -> Tensor:
        """Predict the chunk ``[B, chunk_size, Da]``, normalised.

        Args:
            state: ``[B, Ds]``, normalised; None where the policy reads none.
            environment: ``[B, De]``, likewise.
            images: of each camera ``[B, 3, H, W]``, normalised.
        """
        tokens = list[Tensor]()
        if state is not None:
            tokens.append(self.encoder_robot_state_input_proj(state).unsqueeze(1))
        if environment is not None:
            tokens.append(self.encoder_env_state_input_proj(environment).unsqueeze(1))
        seen = [self.encoder_img_feat_input_proj(self.backbone(image)) for image in images]
        tokens += [features.flatten(2).transpose(1, 2) for features in seen]
        latent = self.encoder_latent_input_proj.bias.expand(tokens[0].shape[0], 1, -1)  # of zeros
        pixels = (self.get_buffer(f"pixels{number}") for number in range(len(images)))
        places = torch.cat((self.encoder_1d_feature_pos_embed.weight, *pixels))
        memory = self.encoder(torch.cat((latent, *tokens), dim=1), places)
        queries = self.decoder_pos_embed.weight.expand(len(memory), -1, -1)
        made = self.decoder(torch.zeros_like(queries), queries, memory, memory + places)
        return self.action_head(made)  # type: ignore[no-any-return]


def positions_2d(height: int, width: int, channels: int) -> Tensor:
    """Sines and cosines of where the pixels of a feature map are, ``[height * width, channels]``.

    Half of the channels are of the row, the others of the column, both counted from 1 and scaled to at most 2 pi.
    """
    half = channels // 2
    frequencies = 10000 ** (2 * (torch.arange(half, dtype=torch.float32) // 2) / half)

    def waves(count: int) -> Tensor:
        places = torch.arange(1, count + 1, dtype=torch.float32)
        angles = (places / (places[-1:] + 1e-6) * (2 * math.pi))[:, None] / frequencies
        return torch.stack((angles[:, 0::2].sin(), angles[:, 1::2].cos()), dim=-1).flatten(1)

    rows = waves(height)[:, None].expand(-1, width, -1)
    return torch.cat((rows, waves(width)[None].expand(height, -1, -1)), dim=-1).flatten(0, 1)
