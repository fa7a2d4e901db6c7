"""The two encoders of CLIP, rebuilt from their configuration: image to class token, tokens to sentence feature.

Written from the description of the network, with attribute names under which the weights of transformers' ``CLIPModel``
load as they are, so that converting a policy needs no transformers.

Source: Radford et al., Learning Transferable Visual Models From Natural Language Supervision (arXiv 2103.00020).
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from .clip_config import TextConfig, TowerConfig, VisionConfig


class _SelfAttention(nn.Module):
    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        width = config.hidden_size
        self.heads = config.num_attention_heads
        self.q_proj, self.k_proj = nn.Linear(width, width), nn.Linear(width, width)
        self.v_proj, self.out_proj = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: torch.Tensor, mask: torch.Tensor | None, read: int) -> torch.Tensor:
        """``[B, tokens, width]`` -> the first ``read`` tokens of the result."""
        width = x.shape[-1]
        q, k, v = (
            project(tokens).unflatten(-1, (self.heads, width // self.heads)).transpose(1, 2)
            for project, tokens in ((self.q_proj, x[:, :read]), (self.k_proj, x), (self.v_proj, x))
        )
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out_proj(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class _FeedForward(nn.Module):
    """With ``quick_gelu``, which is ``x * sigmoid(1.702 x)``, or the exact ``gelu`` between its two layers."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.fc1 = nn.Linear(config.hidden_size, config.intermediate_size)
        self.quick = config.hidden_act == "quick_gelu"
        self.fc2 = nn.Linear(config.intermediate_size, config.hidden_size)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.fc1(x)
        return self.fc2(x * torch.sigmoid(1.702 * x) if self.quick else functional.gelu(x))  # type: ignore[no-any-return]


class _Layer(nn.Module):
    """Pre-norm self-attention and feed-forward."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.self_attn = _SelfAttention(config)
        self.layer_norm2 = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.mlp = _FeedForward(config)

    def forward(self, x: torch.Tensor, mask: torch.Tensor | None, read: int) -> torch.Tensor:
        x = x[:, :read] + self.self_attn(self.layer_norm1(x), mask, read)
        return x + self.mlp(self.layer_norm2(x))  # type: ignore[no-any-return]


class _Layers(nn.Module):
    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.num_hidden_layers))

    def forward(self, x: torch.Tensor, mask: torch.Tensor | None = None, read: int | None = None) -> torch.Tensor:
        """All layers; of the last one only the first ``read`` tokens, because nobody reads the others."""
        *others, last = self.layers
        for layer in others:
            x = layer(x, mask, x.shape[1])
        return last(x, mask, x.shape[1] if read is None else read)  # type: ignore[no-any-return]


class _VisionEmbeddings(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.class_embedding = nn.Parameter(torch.zeros(width))
        self.patch_embedding = nn.Conv2d(config.num_channels, width, patch, stride=patch, bias=False)
        self.position_embedding = nn.Embedding(config.patches + 1, width)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        patches = self.patch_embedding(pixels).flatten(2).transpose(1, 2)
        positions = self.position_embedding.weight
        first = (self.class_embedding + positions[0])[None]
        # The class token is a row of zeros to which it is added with its position: a constant, whatever the batch.
        return functional.pad(patches, (0, 0, 1, 0)) + torch.cat((first, positions[1:]))


class ClipVision(nn.Module):
    """Pixels ``[N, 3, size, size]`` to the class token after the last layer ``[N, width]``, not normalised."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.embeddings = _VisionEmbeddings(config)
        # The names, spelling included, are those of the weights.
        self.pre_layrnorm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.encoder = _Layers(config)
        self.post_layernorm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)  # of the pooled output

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """See the class."""
        tokens = self.pre_layrnorm(self.embeddings(pixels))
        return self.encoder(tokens, read=1)[:, 0]  # type: ignore[no-any-return]


class _TextEmbeddings(nn.Module):
    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.token_embedding = nn.Embedding(config.vocab_size, config.hidden_size)
        self.position_embedding = nn.Embedding(config.max_position_embeddings, config.hidden_size)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return self.token_embedding(tokens) + self.position_embedding.weight[: tokens.shape[1]]  # type: ignore[no-any-return]


class ClipText(nn.Module):
    """Tokens int64 ``[B, L]`` and their mask bool ``[B, L]`` to the feature of the end token ``[B, width]``.

    The end token is the first that equals ``eos_token_id``; for ``eos_token_id = 2``, which old configurations say
    wrongly, it is the largest of the row.
    """

    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.end = config.eos_token_id
        self.embeddings = _TextEmbeddings(config)
        self.encoder = _Layers(config)
        self.final_layer_norm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """See the class."""
        length = tokens.shape[1]
        square = torch.ones(length, length, dtype=torch.bool)
        # Padding sees at least itself: an attention to nothing is not the same number everywhere. Nobody sees it.
        allowed = (square.tril() & mask[:, None, None, :]) | torch.eye(length, dtype=torch.bool)
        added = torch.where(allowed, 0.0, torch.finfo(torch.float32).min)
        features = self.final_layer_norm(self.encoder(self.embeddings(tokens), added))
        ids = tokens.to(torch.int32)  # ArgMax of ONNX knows no int64
        end = (ids if self.end == 2 else (ids == self.end).to(torch.int32)).argmax(dim=-1)
        index = end[:, None, None].expand(-1, 1, features.shape[2])
        return torch.gather(features, 1, index)[:, 0]
