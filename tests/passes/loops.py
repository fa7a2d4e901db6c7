"""A policy of several loops, compiled once with all of them, and once with each."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from onnx import ModelProto
from torch import nn

from tests.passes.modules import MODULES, Skipping
from tests.passes.specs import toy_spec
from ttscompile import PolicySpec, SamplerTable
from ttscompile.driver import transform
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.samplers.table import sampler_table

BETAS = {"num_train_timesteps": 40, "beta_schedule": "squaredcos_cap_v2"}


def table(scheduler: Callable[..., object], steps: int, **settings: object) -> SamplerTable:
    return sampler_table(scheduler(**BETAS, **settings), steps)


LOOPS = {
    "ddpm-4": table(DDPMScheduler, 4),
    "ddim-6-trailing": table(DDIMScheduler, 6, timestep_spacing="trailing"),
    "ddim-3": table(DDIMScheduler, 3, clip_sample=False),
    "dpmsolver++-4": table(DPMSolverMultistepScheduler, 4),
}


def spec() -> PolicySpec:
    made = toy_spec(sample=(4, 2), obs=(3, 7))
    return replace(made, sampler=table(DDPMScheduler, 6), loops=LOOPS)


class Encoder(nn.Module):
    """A condition that the original computes once a call."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(7, 7)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.net(observations["obs"])


def encoded() -> nn.Module:
    return EncodedDenoiser(Encoder(), MODULES["tokens"]())


BUILT = {"tokens": MODULES["tokens"], "adaLN": MODULES["adaLN"], "skip": Skipping, "encoder": encoded}


def module_of(kind: str) -> nn.Module:
    torch.manual_seed(0)
    return BUILT[kind]().eval()


@cache
def program_of(kind: str, loop: str | None = None) -> Program:
    """The program of all loops, or that of one alone."""
    return transform(module_of(kind), spec() if loop is None else spec().in_loop(loop))


@cache
def models_of(loop: str | None = None) -> dict[str, ModelProto]:
    return lower_program(program_of("tokens", loop))
