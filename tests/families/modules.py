"""Denoisers that nobody prepared, as their authors would write them; names of attributes say nothing.

All take ``sample [B, 6, 3]``, ``timestep [B]`` and ``obs [B, 5, 7]``, and have two layers of width 16.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from .layers import ByHand, Fused, Gated, Root, Waves, feed_forward

HORIZON, CHANNELS, TOKENS, FEATURES, WIDTH, LAYERS = 6, 3, 5, 7, 16, 2


class Base(nn.Module):
    """Embeddings and a head; the layers are in between."""

    def __init__(self) -> None:
        super().__init__()
        self.a: nn.Module = nn.Linear(CHANNELS, WIDTH)
        self.z: nn.Module = nn.Linear(WIDTH, CHANNELS)
        self.o = nn.Linear(FEATURES, WIDTH)
        self.w = Waves(WIDTH)
        self.p = nn.Parameter(0.1 * torch.randn(1, HORIZON, WIDTH))


class OwnDiT(Base):
    """DiT: adaLN-Zero with six modulations a layer, and a head that also predicts a variance."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(Fused(WIDTH) for _ in range(LAYERS))
        self.v = nn.ModuleList(feed_forward(WIDTH) for _ in range(LAYERS))
        self.m = nn.ModuleList(nn.Sequential(nn.SiLU(), nn.Linear(WIDTH, 6 * WIDTH)) for _ in range(LAYERS))
        self.n = nn.LayerNorm(WIDTH, elementwise_affine=False, eps=1e-6)
        self.f = nn.Sequential(nn.SiLU(), nn.Linear(WIDTH, 2 * WIDTH))
        self.z = nn.Linear(WIDTH, 2 * CHANNELS)

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        c = self.w(timestep) + self.o(obs).mean(1)
        x = self.a(sample) + self.p
        for attend, feed, modulate in zip(self.u, self.v, self.m, strict=True):
            s1, c1, g1, s2, c2, g2 = modulate(c).chunk(6, dim=1)
            x = x + g1.unsqueeze(1) * attend(self.n(x) * (1 + c1.unsqueeze(1)) + s1.unsqueeze(1))
            x = x + g2.unsqueeze(1) * feed(self.n(x) * (1 + c2.unsqueeze(1)) + s2.unsqueeze(1))
        shift, scale = self.f(c).chunk(2, dim=1)
        mean, _ = self.z(self.n(x) * (1 + scale.unsqueeze(1)) + shift.unsqueeze(1)).chunk(2, dim=-1)
        return mean


class PostNorm(Base):
    """BERT: the sum is normalised, so the normalised value is the stream."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(ByHand(WIDTH) for _ in range(LAYERS))
        self.v = nn.ModuleList(feed_forward(WIDTH) for _ in range(LAYERS))
        self.n = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(2 * LAYERS))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = self.a(sample) + self.p + (self.w(timestep) + self.o(obs).mean(1))[:, None]
        for i in range(LAYERS):
            x = self.n[2 * i](x + self.u[i](x))
            x = self.n[2 * i + 1](self.v[i](x) + x)
        return self.z(x)


class Parallel(Base):
    """Attention and feed-forward side by side, as in GPT-J and PaLM: ``x + attention(n) + feed_forward(n)``."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(Fused(WIDTH) for _ in range(LAYERS))
        self.v = nn.ModuleList(feed_forward(WIDTH) for _ in range(LAYERS))
        self.n = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(LAYERS))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = self.a(sample) + self.p + (self.w(timestep) + self.o(obs).mean(1))[:, None]
        for attend, feed, norm in zip(self.u, self.v, self.n, strict=True):
            n = norm(x)
            x = x + attend(n) + feed(n)
        return self.z(x)


class Modern(Base):
    """RMSNorm, SwiGLU, rotary positions, normalised queries and keys; the condition is a prefix of the sequence."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(Fused(WIDTH, norm=True, rope=True) for _ in range(LAYERS))
        self.v = nn.ModuleList(Gated(WIDTH) for _ in range(LAYERS))
        self.n = nn.ModuleList(Root(WIDTH) for _ in range(2 * LAYERS + 1))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = torch.cat([self.w(timestep)[:, None], self.o(obs), self.a(sample)], dim=1)
        for i in range(LAYERS):
            x = x + self.u[i](self.n[2 * i](x))
            x = x + self.v[i](self.n[2 * i + 1](x))
        return self.z(self.n[-1](x)[:, -HORIZON:])


class ChannelsFirst(Base):
    """The stream is ``[B, E, T]``: pointwise convolutions, group normalisation, attention over the last axis."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.z = nn.Conv1d(CHANNELS, WIDTH, 1), nn.Conv1d(WIDTH, CHANNELS, 1)
        self.u = nn.ModuleList(nn.Conv1d(WIDTH, 3 * WIDTH, 1) for _ in range(LAYERS))
        self.y = nn.ModuleList(nn.Conv1d(WIDTH, WIDTH, 1) for _ in range(LAYERS))
        self.v = nn.ModuleList(
            nn.Sequential(nn.Conv1d(WIDTH, 2 * WIDTH, 1), nn.SiLU(), nn.Conv1d(2 * WIDTH, WIDTH, 1))
            for _ in range(LAYERS)
        )
        self.n = nn.ModuleList(nn.GroupNorm(4, WIDTH) for _ in range(2 * LAYERS))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = self.a(sample.transpose(1, 2)) + (self.w(timestep) + self.o(obs).mean(1))[:, :, None]
        for i in range(LAYERS):
            q, k, v = self.u[i](self.n[2 * i](x)).chunk(3, 1)
            weights = torch.einsum("bct,bcs->bts", q, k).mul(WIDTH**-0.5).softmax(-1)
            x = x + self.y[i](torch.einsum("bts,bcs->bct", weights, v))
            x = x + self.v[i](self.n[2 * i + 1](x))
        return self.z(x).transpose(1, 2)


class UViT(Base):
    """Long skips: a layer of the second half reads what one of the first half gave, concatenated and projected."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(Fused(WIDTH) for _ in range(5))
        self.v = nn.ModuleList(feed_forward(WIDTH) for _ in range(5))
        self.n = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(10))
        self.s = nn.ModuleList(nn.Linear(2 * WIDTH, WIDTH) for _ in range(2))

    def layer(self, x: Tensor, i: int) -> Tensor:
        x = x + self.u[i](self.n[2 * i](x))
        return x + self.v[i](self.n[2 * i + 1](x))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = torch.cat([self.w(timestep)[:, None], self.o(obs), self.a(sample)], dim=1)
        kept = []
        for i in range(2):
            x = self.layer(x, i)
            kept.append(x)
        x = self.layer(x, 2)
        for i in range(2):
            x = self.layer(self.s[i](torch.cat([x, kept.pop()], dim=-1)), 3 + i)
        return self.z(x[:, -HORIZON:])


class TwoStreams(Base):
    """MM-DiT: actions and observation are two streams with weights of their own, joined in attention only."""

    def __init__(self) -> None:
        super().__init__()
        self.b = nn.ModuleList(nn.Linear(WIDTH, 3 * WIDTH) for _ in range(2 * LAYERS))
        self.e = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(2 * LAYERS))
        self.v = nn.ModuleList(feed_forward(WIDTH) for _ in range(2 * LAYERS))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x, y = self.a(sample) + self.p, self.o(obs) + self.w(timestep)[:, None]
        for i in range(LAYERS):
            joint = torch.cat([self.b[2 * i](x), self.b[2 * i + 1](y)], 1)
            q, k, v = joint.chunk(3, -1)
            both = functional.scaled_dot_product_attention(q, k, v)
            x = x + self.e[2 * i](both[:, :HORIZON])
            y = y + self.e[2 * i + 1](both[:, HORIZON:])
            x, y = x + self.v[2 * i](x), y + self.v[2 * i + 1](y)
        return self.z(x)


class Guided(OwnDiT):
    """Guidance inside: the batch is doubled, with the observation and with a learned one that stands for none."""

    def __init__(self) -> None:
        super().__init__()
        self.q = nn.Parameter(torch.randn(1, TOKENS, FEATURES))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        obs = torch.cat([obs, self.q.expand(obs.shape[0], -1, -1)], 0)
        both = super().forward(torch.cat([sample, sample], 0), torch.cat([timestep, timestep], 0), obs)
        given, free = both.chunk(2, dim=0)
        return free + 1.5 * (given - free)


class TorchEncoder(Base):
    """``nn.TransformerEncoder`` over time, observation and action tokens."""

    def __init__(self, first: bool = True) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(WIDTH, 2, 32, 0.1, "gelu", batch_first=True, norm_first=first)
        self.t = nn.TransformerEncoder(layer, LAYERS, enable_nested_tensor=False)

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        tokens = torch.cat([self.w(timestep)[:, None], self.o(obs), self.a(sample) + self.p], 1)
        return self.z(self.t(tokens)[:, 1 + TOKENS :])


class TorchDecoder(Base):
    """``nn.TransformerDecoder`` with a causal mask, sequence first, memory of time and observation."""

    def __init__(self) -> None:
        super().__init__()
        layer = nn.TransformerDecoderLayer(WIDTH, 2, 32, 0.1, "gelu", norm_first=True)
        self.t = nn.TransformerDecoder(layer, LAYERS, nn.LayerNorm(WIDTH))
        self.k = nn.Buffer(nn.Transformer.generate_square_subsequent_mask(HORIZON))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        memory = torch.cat([self.w(timestep)[:, None], self.o(obs)], 1).transpose(0, 1)
        x = (self.a(sample) + self.p).transpose(0, 1)
        return self.z(self.t(x, memory, tgt_mask=self.k).transpose(0, 1))


class InContext(Base):
    """Cross-attention by hand to observation tokens, then feed-forward; no self-attention; a mask over the tokens."""

    def __init__(self) -> None:
        super().__init__()
        self.u = nn.ModuleList(ByHand(WIDTH) for _ in range(LAYERS))
        self.v = nn.ModuleList(Gated(WIDTH) for _ in range(LAYERS))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        memory = functional.gelu(self.o(obs))
        x = self.a(sample) + self.w(timestep)[:, None]
        for attend, feed in zip(self.u, self.v, strict=True):
            x = attend(functional.layer_norm(x, (WIDTH,)), memory) + x
            x = feed(functional.layer_norm(x, (WIDTH,))) + x
        return self.z(x)


class Rotor(Base):
    """Rotary embedding with complex numbers, as Llama's first code has it."""

    def __init__(self) -> None:
        super().__init__()
        self.b, self.e = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        angle = torch.outer(torch.arange(HORIZON), 1 / 100 ** (torch.arange(WIDTH // 4) / (WIDTH // 4)))
        self.r = nn.Buffer(torch.polar(torch.ones_like(angle), angle))

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
        x = self.a(sample) + (self.w(timestep) + self.o(obs).mean(1))[:, None]
        for _ in range(LAYERS):
            q, k, v = (part.unflatten(-1, (2, -1)) for part in self.b(functional.layer_norm(x, (WIDTH,))).chunk(3, -1))
            q, k = (
                torch.view_as_real(torch.view_as_complex(one.unflatten(-1, (-1, 2))) * self.r[:, None]).flatten(3)
                for one in (q, k)
            )
            q, k, v = (one.transpose(1, 2) for one in (q, k, v))
            y = functional.scaled_dot_product_attention(q, k, v)
            x = x + self.e(y.transpose(1, 2).flatten(2))
        return self.z(x)


MODULES: dict[str, Callable[[], nn.Module]] = {
    "own DiT, adaLN-Zero, learned sigma": OwnDiT,
    "BERT, post-norm": PostNorm,
    "parallel attention and feed-forward": Parallel,
    "RMSNorm, SwiGLU, RoPE, qk-norm": Modern,
    "channels first": ChannelsFirst,
    "U-ViT": UViT,
    "MM-DiT": TwoStreams,
    "guidance": Guided,
    "nn.TransformerEncoder, pre-norm": TorchEncoder,
    "nn.TransformerEncoder, post-norm": lambda: TorchEncoder(first=False),
    "nn.TransformerDecoder": TorchDecoder,
    "cross-attention only": InContext,
    "complex RoPE": Rotor,
}
