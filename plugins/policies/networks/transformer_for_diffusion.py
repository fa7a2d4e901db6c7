"""The transformer of Diffusion Policy, rebuilt from its configuration.

Written from the description of the network, with attribute names under which the weights of an original checkpoint
load as they are. The layers are PyTorch's own; they are looped over here, because ``nn.TransformerDecoder`` reads the
data of a causal mask and so cannot be exported.

Source: Chi et al., Diffusion Policy (arXiv 2303.04137), the time-series diffusion transformer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import nn

from ttscompile.errors import CheckpointError


@dataclass(frozen=True)
class TransformerConfig:
    """Sizes and variant of one network; the names are those of the original configuration.

    Attributes:
        horizon: T, the largest number of sample tokens.
        n_obs_steps: To, observation tokens; the horizon where the configuration has none.
        cond_dim: channels of an observation token; 0 for no observation tokens.
        causal_attn: whether a token sees only its past, and observations up to its time.
        time_as_cond: whether the timestep is a memory token (decoder) or the first token of the trunk (encoder only).
        n_cond_layers: transformer layers of the condition encoder; 0 for a token-wise MLP.
    """

    input_dim: int
    output_dim: int
    horizon: int
    n_obs_steps: int
    cond_dim: int = 0
    n_layer: int = 12
    n_head: int = 12
    n_emb: int = 768
    causal_attn: bool = False
    time_as_cond: bool = True
    n_cond_layers: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            wanted = bool if field.type == "bool" else int
            if type(value) is not wanted:
                raise CheckpointError(f"cfg.policy.model.{field.name} is {value!r}; expected {wanted.__name__}.")
            smallest = 0 if field.name in ("cond_dim", "n_cond_layers") else 1
            if wanted is int and value < smallest:
                raise CheckpointError(f"cfg.policy.model.{field.name} is {value}; expected at least {smallest}.")
        if self.n_emb % self.n_head or self.n_emb % 2 or self.n_emb < 4:
            found = f"n_emb = {self.n_emb} with n_head = {self.n_head}"
            raise CheckpointError(f"cfg.policy.model: {found}; expected an even width from 4 on that the heads divide.")
        if self.cond_dim and not self.time_as_cond:
            raise CheckpointError("cfg.policy.model: cond_dim > 0 needs time_as_cond; the original refuses this, too.")

    @property
    def trunk_tokens(self) -> int:
        """Tokens of the trunk: T, and the timestep where it is one of them."""
        return self.horizon + (not self.time_as_cond)

    @property
    def memory_tokens(self) -> int:
        """Tokens of the condition encoder: the timestep and To observations; 0 without a decoder."""
        return self.time_as_cond + (self.n_obs_steps if self.cond_dim else 0)


class SinusoidalEmbedding(nn.Module):
    """Timestep to ``n_emb`` sines and cosines of geometrically falling frequencies, from 1 down to 1/10000."""

    frequencies: torch.Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        half = width // 2
        step = math.log(10000) / (half - 1)
        # Not persistent: checkpoints do not hold it. Of numbers in a network on the meta device, too.
        rates = torch.exp(torch.arange(half, device="cpu") * -step)
        self.register_buffer("frequencies", rates, persistent=False)

    def forward(self, timestep: torch.Tensor) -> torch.Tensor:
        """``[B]`` -> ``[B, width]``."""
        angles = timestep[:, None] * self.frequencies[None, :]
        return torch.cat((angles.sin(), angles.cos()), dim=-1)


class Layers(nn.Module):
    """Pre-norm ``nn.TransformerEncoderLayer`` or ``nn.TransformerDecoderLayer`` in a row."""

    def __init__(self, layer: type[nn.Module], config: TransformerConfig, count: int) -> None:
        super().__init__()
        settings = {"dropout": 0.0, "activation": "gelu", "batch_first": True, "norm_first": True}
        width = config.n_emb
        self.layers = nn.ModuleList(layer(width, config.n_head, 4 * width, **settings) for _ in range(count))

    def forward(self, x: torch.Tensor, *memory: torch.Tensor, **masks: torch.Tensor | None) -> torch.Tensor:
        """``[B, tokens, n_emb]`` -> the same; a mask ``[tokens, tokens]`` is added to the attention logits."""
        for layer in self.layers:
            x = layer(x, *memory, **masks)
        return x


class TransformerForDiffusion(nn.Module):
    """The denoiser: noisy sample, timestep and observation tokens to a prediction.

    Decoder form (``time_as_cond``): memory = encoder([time, observations] + positions); the trunk attends to it.
    Encoder-only form: the trunk is [time, sample] + positions, and the first token is dropped at the end.
    """

    mask: torch.Tensor | None
    memory_mask: torch.Tensor | None

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.config = config
        width = config.n_emb
        self.input_emb = nn.Linear(config.input_dim, width)
        self.pos_emb = nn.Parameter(torch.zeros(1, config.trunk_tokens, width))
        self.time_emb = SinusoidalEmbedding(width)
        self.cond_obs_emb = nn.Linear(config.cond_dim, width) if config.cond_dim else None
        self.encoder: nn.Module
        self.decoder: Layers | None = None
        if config.time_as_cond:
            self.cond_pos_emb = nn.Parameter(torch.zeros(1, config.memory_tokens, width))
            if config.n_cond_layers:
                self.encoder = Layers(nn.TransformerEncoderLayer, config, config.n_cond_layers)
            else:
                self.encoder = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
            self.decoder = Layers(nn.TransformerDecoderLayer, config, config.n_layer)
        else:
            self.encoder = Layers(nn.TransformerEncoderLayer, config, config.n_layer)

        self.register_buffer("mask", None)
        self.register_buffer("memory_mask", None)
        if config.causal_attn:
            forbidden = torch.full((config.trunk_tokens, max(config.trunk_tokens, config.memory_tokens)), -math.inf)
            self.mask = forbidden[:, : config.trunk_tokens].triu(1)
            if config.cond_dim:
                # Memory token 0 is the timestep, token s is the observation of time s - 1.
                self.memory_mask = forbidden[:, : config.memory_tokens].triu(2)

        self.ln_f = nn.LayerNorm(width)
        self.head = nn.Linear(width, config.output_dim)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, cond: torch.Tensor | None = None) -> torch.Tensor:
        """Evaluate the denoiser once.

        Args:
            sample: float32 ``[B, T, input_dim]``, T at most the horizon.
            timestep: int64 ``[B]``.
            cond: float32 ``[B, To, cond_dim]``; None without observation tokens.

        Returns:
            float32 ``[B, T, output_dim]``.
        """
        time = self.time_emb(timestep).unsqueeze(1)
        tokens = self.input_emb(sample)
        if self.decoder is None:
            tokens = torch.cat((time, tokens), dim=1)
        count = tokens.shape[1]  # fewer than the horizon's, where only the first steps are predicted
        mask = None if self.mask is None else self.mask[:count, :count]
        if self.decoder is None:
            x = self.encoder(tokens + self.pos_emb[:, :count], src_mask=mask)[:, 1:]
        else:
            memory = time if self.cond_obs_emb is None else torch.cat((time, self.cond_obs_emb(cond)), dim=1)
            memory = self.encoder(memory + self.cond_pos_emb[:, : memory.shape[1]])
            memory_mask = None if self.memory_mask is None else self.memory_mask[:count]
            tokens = tokens + self.pos_emb[:, :count]
            x = self.decoder(tokens, memory, tgt_mask=mask, memory_mask=memory_mask)
        return self.head(self.ln_f(x))  # type: ignore[no-any-return]
