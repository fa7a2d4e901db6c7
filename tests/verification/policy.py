"""A policy of ten steps and six blocks, large enough that what is not computed is time saved, and plans for it."""

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from tests.calibration import policies
from ttscompile import PolicySpec
from ttscompile.core.lattice import Source, whole_steps_plan

STEPS, HORIZON, CHANNELS = policies.STEPS, policies.HORIZON, policies.CHANNELS
WIDTH, LAYERS, BLOCKS = 128, 3, 6


class Network(nn.Module):
    """Blocks 0, 2, 4 mix tokens and see the time; blocks 1, 3, 5 mix channels and see the observation."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed = nn.Linear(CHANNELS, WIDTH)
        self.encode = nn.Sequential(nn.Linear(6, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH))
        self.time = nn.Embedding(STEPS, WIDTH)
        self.mix = nn.ModuleList(nn.Linear(HORIZON, 2 * HORIZON) for _ in range(LAYERS))
        self.back = nn.ModuleList(nn.Linear(2 * HORIZON, HORIZON) for _ in range(LAYERS))
        self.wide = nn.ModuleList(nn.Linear(WIDTH, 8 * WIDTH) for _ in range(LAYERS))
        self.narrow = nn.ModuleList(nn.Linear(8 * WIDTH, WIDTH) for _ in range(LAYERS))
        self.head = nn.Linear(WIDTH, CHANNELS)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        condition, time = self.encode(obs.flatten(1)).unsqueeze(1), self.time(timestep).unsqueeze(1)
        h = self.embed(sample)
        for mix, back, wide, narrow in zip(self.mix, self.back, self.wide, self.narrow, strict=True):
            h = h + back(nn.functional.gelu(mix((h + time).transpose(1, 2)))).transpose(1, 2)
            h = h + narrow(nn.functional.gelu(wide(nn.functional.layer_norm(h, (WIDTH,)) + condition)))
        return self.head(h)


def spec() -> PolicySpec:
    """With so much noise that what reuse changes is less."""
    return policies.spec(noise=0.3)


def sparse() -> npt.NDArray[np.int8]:
    """Three full steps of ten, and one block of a fourth."""
    plan = whole_steps_plan(STEPS, BLOCKS, [0, 4, 8])
    plan[6, 2] = Source.COMPUTE
    plan[6, 4] = Source.FORWARD
    return plan


def other() -> npt.NDArray[np.int8]:
    """The second half of the blocks at every other step."""
    plan = whole_steps_plan(STEPS, BLOCKS, [0])
    plan[1::2, 3:] = Source.COMPUTE
    return plan


def sparsest() -> npt.NDArray[np.int8]:
    """Step 0 alone."""
    return whole_steps_plan(STEPS, BLOCKS, [0])


def shifted(plan: npt.NDArray[np.int8]) -> npt.NDArray[np.int8]:
    """Everything a step later; step 0 is dense in every plan."""
    return np.concatenate([plan[:1], plan[:-1]])
