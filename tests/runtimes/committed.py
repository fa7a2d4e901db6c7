"""A small denoiser that was trained to go on from a prefix: its norms are modulated by a row for each action."""

from pathlib import Path

import numpy as np
import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import Tensor, nn

import ttscompile
from ttscompile import Affine, ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.ir.program import Program
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table

HORIZON, CHANNELS, ACTIONS, START, LONGEST, WIDTH, LAYERS = 6, 3, 2, 1, 3, 8, 2


class Network(nn.Module):
    """Gated blocks: each mixes the tokens, and then their channels."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed, self.head, self.read = nn.Linear(CHANNELS, WIDTH), nn.Linear(WIDTH, CHANNELS), nn.Linear(4, WIDTH)
        self.modulation = nn.ModuleList(nn.Linear(WIDTH, 3 * WIDTH) for _ in range(LAYERS))
        self.mix = nn.ModuleList(nn.Linear(HORIZON, HORIZON) for _ in range(LAYERS))
        self.wide = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(LAYERS))
        self.frequencies = nn.Buffer(torch.arange(1, WIDTH // 2 + 1) / 4)

    def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor, committed: Tensor) -> Tensor:
        """``committed`` is int64 ``[B, 1]``; theirs is the time 0, whatever the step's."""
        clean = (torch.arange(HORIZON) >= START) & (torch.arange(HORIZON) < START + committed)
        own, other = self.waves(timestep.float()), self.waves(torch.zeros(1))
        h, seen = self.embed(sample), self.read(obs)[:, None]
        for modulation, mix, wide in zip(self.modulation, self.mix, self.wide, strict=True):
            both = (modulation(time)[:, None].chunk(3, -1) for time in (other, own))
            scale, shift, gate = (torch.where(clean[..., None], a, b) for a, b in zip(*both, strict=True))
            normed = nn.functional.layer_norm(h, (WIDTH,)) * scale + shift
            h = h + gate * torch.tanh(mix((normed + seen).transpose(1, 2)).transpose(1, 2))
            h = h + torch.tanh(wide(nn.functional.layer_norm(h, (WIDTH,)) * scale + shift))
        return self.head(h)

    def waves(self, time: Tensor) -> Tensor:
        angle = time[:, None] * self.frequencies
        return torch.cat([angle.sin(), angle.cos()], -1)


def spec(sampler: SamplerTable) -> PolicySpec:
    """Of the three channels two are actions."""
    normalizer = Affine(np.array([0.5, 2.0]), np.array([0.2, -0.1]))
    chunk = ChunkSpec(ACTIONS, START, HORIZON - 1, normalizer)
    return PolicySpec((HORIZON, CHANNELS), {"obs": ObservationSpec((4,))}, sampler, chunk, trained_prefix=LONGEST)


def ddpm() -> SamplerTable:
    """Eight steps that draw noise."""
    return sampler_table(DDPMScheduler(num_train_timesteps=40, beta_schedule="squaredcos_cap_v2"), 8)


def rk4() -> SamplerTable:
    """Two steps of the method of Runge and Kutta: eight evaluations, which tell no noise levels."""
    return flow_matching_table(2, "rk4", start=1.0, end=0.0)


SAMPLERS = {"ddpm": ddpm, "rk4": rk4}


def compiled(name: str, folder: Path) -> Program:
    """The policy with one of the samplers: the artifact."""
    return ttscompile.compile_denoiser(Network(), spec(SAMPLERS[name]()), folder)
