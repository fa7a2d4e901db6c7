"""A small policy that sees: an image encoder, convolutions and a linear layer, in front of a loop of three blocks."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

import ttscompile
from tests.once import Once
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.ir.program import Program
from ttscompile.samplers.flow import flow_matching_table

WIDTH, FEATURES, HORIZON, ACTIONS, STEPS = 32, 64, 4, 2, 4
LARGE = 500
"""Weights of the encoder's last layer are so many times what they come as: actions depend on what is seen."""


class Eye(nn.Module):
    """``[B, 3, 16, 16]`` to ``[B, 64]``.

    Args:
        loud: how large a channel is that the last layer reads and makes nothing of: it takes all of the eight bits.
    """

    def __init__(self, loud: float) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 32, 3, stride=2, padding=1)
        self.second = nn.Conv2d(32, FEATURES, 3, stride=2, padding=1)
        self.last = nn.Linear(FEATURES, FEATURES)
        with torch.no_grad():
            assert self.second.bias is not None
            self.second.bias[0] = loud
            self.last.weight *= LARGE
            self.last.weight[:, 0] *= float(loud == 0)

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """See the class."""
        seen = torch.relu(self.second(torch.relu(self.first(observations["image"]))))
        return self.last(seen.flatten(2).transpose(1, 2)).mean(1)


class Hand(nn.Module):
    """Feed-forward blocks that read what was seen, mixed with the time: one row a step, in the piece ``step``."""

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.leave = nn.Linear(ACTIONS, WIDTH), nn.Linear(WIDTH, ACTIONS)
        self.reads = nn.ModuleList(nn.Linear(FEATURES, WIDTH) for _ in range(3))
        self.mixes = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(3))
        inner = (nn.Sequential(nn.Linear(WIDTH, 2 * WIDTH), nn.GELU(), nn.Linear(2 * WIDTH, WIDTH)) for _ in range(3))
        self.blocks = nn.ModuleList(inner)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """``[B, 4, 2]``, ``[B]`` and ``[B, 64]`` -> ``[B, 4, 2]``."""
        x = self.enter(sample)
        for read, mix, block in zip(self.reads, self.mixes, self.blocks, strict=True):
            x = x + block(x + mix(torch.relu(read(seen) + timestep[:, None]))[:, None])
        return self.leave(x)


def compiled(once: Once) -> tuple[Path, Program]:
    """The artifact in eight bits, beside it ``call.onnx``, the single file; and its program."""

    def make(path: Path) -> Program:
        return ttscompile.compile_denoiser(*policy(), path, precision="int8", single_file=path.parent / "call.onnx")

    return once.compiled("seeing int8", make)


def policy(loud: float = 0.0) -> tuple[nn.Module, PolicySpec]:
    """The policy and its specification; see ``Eye``."""
    torch.manual_seed(0)
    spec = PolicySpec(
        sample=(HORIZON, ACTIONS),
        observations={"image": ObservationSpec((3, 16, 16), window=False)},
        sampler=flow_matching_table(STEPS),
        chunk=ChunkSpec(ACTIONS, 0, HORIZON),
    )
    return EncodedDenoiser(Eye(loud), Hand()).eval(), spec
