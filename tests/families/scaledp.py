"""ScaleDP, the action head of DexVLA: a DiT with adaLN-Zero, modulated by the sum of timestep and observation.

Parameters are called as in the original. It computes the waves of its timestep in bfloat16 whatever its weights are.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.heads.layers import TimmAttention, TimmMlp


class _Timestep(nn.Module):
    """An artifact has no bfloat16: the waves of each training timestep are a table, and take no part in the capture."""

    waves: Tensor

    def __init__(self, width: int, timesteps: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(256, width), nn.SiLU(), nn.Linear(width, width))
        rates = torch.exp(-math.log(10000) * torch.arange(128, dtype=torch.bfloat16) / 128)
        angle = torch.arange(timesteps)[:, None].float() * rates
        waves = torch.cat([angle.cos(), angle.sin()], -1).bfloat16().float()
        self.register_buffer("waves", waves, persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        return self.mlp(self.waves[t.long()])


def _modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return functional.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale[:, None]) + shift[:, None]


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.mlp = TimmAttention(width, heads), TimmMlp(width)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        shift, scale, gate, shift2, scale2, gate2 = self.adaLN_modulation(c).chunk(6, 1)
        x = x + gate[:, None] * self.attn(_modulated(x, shift, scale))
        return x + gate2[:, None] * self.mlp(_modulated(x, shift2, scale2))


class _Final(nn.Module):
    def __init__(self, width: int, actions: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, actions)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))


class ScaleDPHead(nn.Module):
    """``model_forward``; inputs ``sample [B, T, D]``, ``timestep [B]``, ``features [B, 1, .]``, ``state [B, .]``.

    ``features`` is what the vision-language model leaves after FiLM, ``action_hidden_states`` in the original.
    """

    def __init__(
        self, width: int, heads: int, layers: int, hidden: int, horizon: int, actions: int, features: int, state: int
    ) -> None:
        super().__init__()
        self.combine = nn.Sequential(
            nn.Linear(features + state, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, features),
        )
        self.x_embedder, self.t_embedder = nn.Linear(actions, width), _Timestep(width, timesteps=100)
        self.cond_obs_emb = nn.Linear(features, width)
        self.pos_embed = nn.Parameter(torch.zeros(1, horizon, width))
        self.blocks = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.final_layer = _Final(width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, features: Tensor, state: Tensor) -> Tensor:
        observed = self.cond_obs_emb(self.combine(torch.cat([features[:, 0], state], -1)))
        c = self.t_embedder(timestep) + observed
        x = self.x_embedder(sample) + self.pos_embed
        for layer in self.blocks:
            x = layer(x, c)
        shift, scale = self.final_layer.adaLN_modulation(c).chunk(2, 1)
        return self.final_layer.linear(_modulated(x, shift, scale))
