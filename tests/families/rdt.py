"""RDT-1B's denoiser with its adaptors: self-attention, cross-attention to language or image by turns, feed-forward.

Parameters are called as in an RDT checkpoint. The norm divides by the deviation, not by the root of the mean square:
that is what timm 1.0.3 does, which RDT was trained with.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import TimestepEmbedder


class _Norm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.var(-1, keepdim=True) + 1e-6) * self.weight


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int, crosses: bool) -> None:
        super().__init__()
        self.heads, self.crosses = heads, crosses
        if crosses:
            self.q, self.kv = nn.Linear(width, width), nn.Linear(width, 2 * width)
        else:
            self.qkv = nn.Linear(width, 3 * width)
        self.q_norm, self.k_norm = _Norm(width // heads), _Norm(width // heads)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """``memory [B, S, E]`` to attend to, or x itself; mask bool ``[B, S]``."""
        parts = self.qkv(x).chunk(3, -1) if memory is None else (self.q(x), *self.kv(memory).chunk(2, -1))
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        seen = None if mask is None else mask[:, None, None].expand(-1, -1, x.shape[1], -1)
        y = functional.scaled_dot_product_attention(self.q_norm(q), self.k_norm(k), v, attn_mask=seen)
        return self.proj(y.transpose(1, 2).flatten(2))


class _Mlp(nn.Module):
    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, width), nn.Linear(width, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x), approximate="tanh"))


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.cross_attn = _Attention(width, heads, False), _Attention(width, heads, True)
        self.norm1, self.norm2, self.norm3 = (_Norm(width) for _ in range(3))
        self.ffn = _Mlp(width, width)

    def forward(self, x: Tensor, memory: Tensor, mask: Tensor | None) -> Tensor:
        x = self.attn(self.norm1(x)) + x
        x = self.cross_attn(self.norm2(x), memory, mask) + x
        return self.ffn(self.norm3(x)) + x


class _Final(nn.Module):
    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.norm_final, self.ffn_final = _Norm(width), _Mlp(width, out)


class _RDT(nn.Module):
    def __init__(self, width: int, heads: int, layers: int, horizon: int, out: int, lengths: tuple[int, int]) -> None:
        super().__init__()
        self.horizon = horizon
        self.t_embedder, self.freq_embedder = TimestepEmbedder(width), TimestepEmbedder(width)
        self.x_pos_embed = nn.Parameter(torch.zeros(1, horizon + 3, width))
        self.lang_cond_pos_embed = nn.Parameter(torch.zeros(1, lengths[0], width))
        self.img_cond_pos_embed = nn.Parameter(torch.zeros(1, lengths[1], width))
        self.blocks = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.final_layer = _Final(width, out)

    def forward(self, x: Tensor, frequency: Tensor, t: Tensor, language: Tensor, image: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.t_embedder(t)[:, None], self.freq_embedder(frequency)[:, None], x], 1) + self.x_pos_embed
        language = language + self.lang_cond_pos_embed[:, : language.shape[1]]
        image = image + self.img_cond_pos_embed
        for i, layer in enumerate(self.blocks):
            x = layer(x, image, None) if i % 2 else layer(x, language, mask)
        return self.final_layer.ffn_final(self.final_layer.norm_final(x))[:, -self.horizon :]


def _adaptor(features: int, width: int, depth: int) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Linear(features, width)]
    for _ in range(depth - 1):
        layers += [nn.GELU(approximate="tanh"), nn.Linear(width, width)]
    return nn.Sequential(*layers)


class RDTHead(nn.Module):
    """One evaluation of ``RDTRunner``; the frozen encoders' tokens are its inputs.

    Inputs: ``sample [B, T, D]``, ``timestep [B]``, ``language [B, L, .]`` with ``language_mask`` bool ``[B, L]``,
    ``image [B, I, .]``, ``state [B, 1, D]``, ``action_mask [B, 1, D]`` of ones and zeros, ``frequency [B]`` in Hz.
    """

    def __init__(
        self, width: int, heads: int, layers: int, horizon: int, actions: int, lengths: tuple[int, int],
        features: tuple[int, int],
    ) -> None:  # fmt: skip
        super().__init__()
        self.horizon = horizon
        self.model = _RDT(width, heads, layers, horizon, actions, lengths)
        self.lang_adaptor, self.img_adaptor = (_adaptor(n, width, 2) for n in features)
        self.state_adaptor = _adaptor(2 * actions, width, 3)

    def forward(
        self, sample: Tensor, timestep: Tensor, language: Tensor, language_mask: Tensor, image: Tensor, state: Tensor,
        action_mask: Tensor, frequency: Tensor,
    ) -> Tensor:  # fmt: skip
        state = self.state_adaptor(torch.cat([state, action_mask], 2))
        actions = self.state_adaptor(torch.cat([sample, action_mask.expand(-1, self.horizon, -1)], 2))
        language, image = self.lang_adaptor(language), self.img_adaptor(image)
        return self.model(torch.cat([state, actions], 1), frequency[:, 0], timestep, language, image, language_mask)
