"""VDD's mixture of experts, as somebody who wraps it would write it; parameters are named as the original's are.

Source: Zhou et al., Variational Distillation of Diffusion Policies into Mixture of Experts (arXiv 2406.12538), which
acts with the mean of one expert. Which one, a gate draws, or the largest one decides (its ``greedy_predict``).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class Attention(nn.Module):
    """Causal."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.key, self.query, self.value, self.proj = (nn.Linear(width, width) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (
            part(x).unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in (self.query, self.key, self.value)
        )
        seen = functional.scaled_dot_product_attention(q, k, v, is_causal=True)
        return self.proj(seen.transpose(1, 2).flatten(2))


class Layer(nn.Module):
    """Pre-norm, as GPT's."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.ln1, self.ln2, self.attn = nn.LayerNorm(width), nn.LayerNorm(width), Attention(width, heads)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.ln1(x))
        return x + self.mlp(self.ln2(x))


class Backbone(nn.Module):
    """Goals and frames become tokens of one sequence, and each frame a row of features."""

    def __init__(self, observation: int, width: int, features: int, window: int, goals: int) -> None:
        super().__init__()
        self.goals = goals
        self.tok_emb, self.pos_emb = nn.Linear(observation, width), nn.Parameter(torch.zeros(1, goals + window, width))
        self.blocks, self.ln_f = nn.Sequential(*[Layer(width, 3) for _ in range(2)]), nn.LayerNorm(width)
        self.head = nn.Sequential(nn.Linear(width, 100), nn.SiLU(), nn.Linear(100, features))

    def forward(self, window: Tensor, goal: Tensor) -> Tensor:
        x = self.tok_emb(torch.cat([goal, window], 1)) + self.pos_emb
        return self.head(self.ln_f(self.blocks(x))[:, self.goals :])


class Residual(nn.Module):
    """Activation, layer, activation, layer, and the input beside."""

    def __init__(self, width: int, act: nn.Module) -> None:
        super().__init__()
        self.l1, self.l2, self.act = nn.Linear(width, width), nn.Linear(width, width), act

    def forward(self, x: Tensor) -> Tensor:
        return x + self.l2(self.act(self.l1(self.act(x))))


class Perceptron(nn.Module):
    """Two hidden layers."""

    def __init__(self, within: int, hidden: int, out: int, act: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(within, hidden), Residual(hidden, act), nn.Linear(hidden, out))

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class Gates(nn.Module):
    """One number for each expert."""

    def __init__(self, features: int, experts: int) -> None:
        super().__init__()
        self.network = Perceptron(features, 8, experts, nn.Mish())

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x)


class Experts(nn.Module):
    """All experts are computed, and the mean of the one with the highest gate is taken."""

    def __init__(
        self, observation: int, action: int, experts: int, window: int, goals: int, features: int = 16
    ) -> None:
        super().__init__()
        self.backbone = Backbone(observation, 24, features, window, goals)
        self.gmm_mean_net = Perceptron(features, features, experts * action, nn.PReLU())  # of its "mish", in lower case
        self.gating_network, self.experts = Gates(features, experts), experts

    def forward(self, window: Tensor, goal: Tensor) -> Tensor:
        """``[B, frames, numbers]``, ``[B, goals, numbers]`` -> ``[B, 1, Da]``, of the newest frame."""
        x = self.backbone(window, goal)[:, -1]
        means, gates = self.gmm_mean_net(x).unflatten(-1, (self.experts, -1)), self.gating_network(x)
        chosen = functional.one_hot(gates.argmax(-1), self.experts).to(means.dtype)
        return (chosen[:, :, None] * means).sum(1, keepdim=True)
