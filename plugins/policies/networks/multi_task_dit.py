"""LeRobot's multi-task DiT, rebuilt: denoiser and observation encoder.

Written from the description of the network, with attribute names under which the weights that lerobot saves load as
they are.

Source: ``lerobot.policies.multi_task_dit`` of huggingface/lerobot 0.6, after Peebles and Xie, Scalable Diffusion Models
with Transformers (arXiv 2212.09748): adaLN-Zero with six modulations a layer.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from .clip import ClipText, ClipVision, TextConfig, VisionConfig
from .language_layers import Rotation, rotate, rotation
from .transformer_for_diffusion import SinusoidalEmbedding


@dataclass(frozen=True)
class DiTConfig:
    """Sizes and variant of the denoiser; the names are those of lerobot's configuration.

    Attributes:
        horizon: T.
        num_layers: layers, of an attention and a feed-forward block each.
        timestep_embed_dim: channels of the timestep's embedding.
        use_positional_encoding: whether learned positions are added to the tokens.
        use_rope: whether queries and keys are rotated by their position.
        rope_base: of the frequencies of that rotation.
    """

    action_dim: int
    horizon: int
    hidden_dim: int
    num_layers: int
    num_heads: int
    timestep_embed_dim: int
    use_positional_encoding: bool
    use_rope: bool
    rope_base: float


class _RotaryAttention(nn.Module):
    """Self-attention whose queries and keys are rotated by position (RoFormer, arXiv 2104.09864)."""

    cos: torch.Tensor
    sin: torch.Tensor

    def __init__(self, config: DiTConfig) -> None:
        super().__init__()
        width = config.hidden_dim
        self.heads, self.head_width = config.num_heads, width // config.num_heads
        self.qkv_proj, self.out_proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        turns = rotation(torch.arange(config.horizon)[None], self.head_width, config.rope_base)
        self.register_buffer("cos", turns.cos, persistent=False)
        self.register_buffer("sin", turns.sin, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, T, width]`` -> the same."""
        _, tokens, width = x.shape
        qkv = self.qkv_proj(x).reshape(-1, tokens, 3, self.heads, self.head_width)
        q, k, v = (qkv[:, :, i].transpose(1, 2) for i in range(3))
        turns = Rotation(self.cos, self.sin)
        mixed = functional.scaled_dot_product_attention(rotate(q, turns), rotate(k, turns), v)
        return self.out_proj(mixed.transpose(1, 2).reshape(-1, tokens, width))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    """adaLN-Zero: both blocks are shifted, scaled and gated by what timestep and observation say."""

    def __init__(self, config: DiTConfig, features: int) -> None:
        super().__init__()
        width = config.hidden_dim
        self.rotary = config.use_rope
        if config.use_rope:
            self.attn = _RotaryAttention(config)
        else:
            self.multihead_attn = nn.MultiheadAttention(width, config.num_heads, batch_first=True)
        self.norm1 = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.norm2 = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width))
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(features, 6 * width))

    def forward(self, x: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """``[B, T, width]`` and ``[B, features]`` -> ``[B, T, width]``."""
        made = self.adaLN_modulation(features).unsqueeze(1).chunk(6, dim=-1)
        shift, scale, gate, mlp_shift, mlp_scale, mlp_gate = made
        moved = self.norm1(x) * (1 + scale) + shift
        if self.rotary:
            mixed = self.attn(moved)
        else:
            mixed, _ = self.multihead_attn(moved, moved, moved, need_weights=False)
        x = x + gate * mixed
        return x + mlp_gate * self.mlp(self.norm2(x) * (1 + mlp_scale) + mlp_shift)  # type: ignore[no-any-return]


class DiffusionTransformer(nn.Module):
    """The denoiser: noisy actions, timestep and condition vector to a prediction."""

    def __init__(self, config: DiTConfig, condition_dim: int) -> None:
        super().__init__()
        time = config.timestep_embed_dim
        self.time_mlp = nn.Sequential(
            SinusoidalEmbedding(time), nn.Linear(time, 2 * time), nn.GELU(), nn.Linear(2 * time, time), nn.GELU()
        )
        self.input_proj = nn.Linear(config.action_dim, config.hidden_dim)
        self.pos_embedding = (
            nn.Parameter(torch.zeros(1, config.horizon, config.hidden_dim)) if config.use_positional_encoding else None
        )
        layers = (_Layer(config, time + condition_dim) for _ in range(config.num_layers))
        self.transformer_blocks = nn.ModuleList(layers)
        self.output_proj = nn.Linear(config.hidden_dim, config.action_dim)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]`` and ``[B, C]`` -> ``[B, T, Da]``."""
        features = torch.cat((self.time_mlp(timestep), condition), dim=-1)
        x = self.input_proj(sample)
        if self.pos_embedding is not None:
            x = x + self.pos_embedding
        for layer in self.transformer_blocks:
            x = layer(x, features)
        return self.output_proj(x)  # type: ignore[no-any-return]


class _TextEncoder(nn.Module):
    def __init__(self, config: TextConfig, width: int) -> None:
        super().__init__()
        self.text_encoder = ClipText(config)
        self.projection = nn.Linear(config.hidden_size, width)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return self.projection(self.text_encoder(tokens, mask))  # type: ignore[no-any-return]


class ObservationEncoder(nn.Module):
    """Window of observations and an instruction to the condition vector.

    Each frame is [state, class tokens of all cameras, instruction]; the frames are concatenated, oldest first.
    """

    def __init__(
        self, cameras: int, vision: VisionConfig | None, text: TextConfig, text_width: int, separate: bool, frames: int
    ) -> None:
        super().__init__()
        self.frames, self.cameras, self.separate = frames, cameras, separate
        if vision is not None:
            each = (nn.Sequential(OrderedDict(model=ClipVision(vision))) for _ in range(cameras if separate else 1))
            if separate:
                self.vision_encoders = nn.ModuleList(each)
            else:
                (self.vision_encoder,) = each
        self.text_encoder = _TextEncoder(text, text_width)

    def forward(
        self, state: torch.Tensor, images: Sequence[torch.Tensor], tokens: torch.Tensor, mask: torch.Tensor
    ) -> torch.Tensor:
        """The condition vector ``[B, C]``.

        Args:
            state: ``[B, To, Ds]``, normalised.
            images: of each camera ``[B * To, 3, size, size]``, normalised.
            tokens: int64 ``[B, L]``.
            mask: bool ``[B, L]``, false for padding.
        """
        parts = [state]
        if images and self.separate:
            seen = [encoder(image) for encoder, image in zip(self.vision_encoders, images, strict=True)]
            parts.append(torch.cat(seen, dim=-1).reshape(-1, self.frames, self.cameras * seen[0].shape[-1]))
        elif images:
            together = self.vision_encoder(torch.stack(list(images), dim=1).flatten(0, 1))
            parts.append(together.reshape(-1, self.frames, self.cameras * together.shape[-1]))
        sentence = self.text_encoder(tokens, mask)
        parts.append(sentence.unsqueeze(1).expand(-1, self.frames, -1))
        if sentence.shape[0] == 1:  # one instruction, known when the policy is compiled, for all streams
            parts[-1] = parts[-1].expand(state.shape[0], -1, -1)
        return torch.cat(parts, dim=-1).flatten(1)
