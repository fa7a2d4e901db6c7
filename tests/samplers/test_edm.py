"""EDM's preconditioning against its formulas, from the module to the actions."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import EDMDenoiser, edm_table
from ttscompile.core.spec import ChunkSpec, Noise, ObservationSpec, PolicySpec
from ttscompile.errors import SpecError
from ttscompile.frontends.eager import eager_policy

DATA = 0.5
SIGMAS = [*np.exp(np.linspace(np.log(3.0), np.log(0.01), 5)).tolist(), 0.0]  # get_sigmas_exponential(5, 0.01, 3)
SAMPLE = (4, 2)


class Network(nn.Module):
    """F: two blocks on a stream."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.stem, self.tail, self.condition = nn.Linear(2, 16), nn.Linear(16, 2), nn.Linear(3, 16)
        self.blocks = nn.ModuleList(nn.Sequential(nn.Linear(16, 32), nn.GELU(), nn.Linear(32, 16)) for _ in range(2))

    def forward(self, sample: torch.Tensor, sigma: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        stream = self.stem(sample)
        for block in self.blocks:
            stream = stream + block(stream + (self.condition(state) + sigma.log()[:, None] / 4)[:, None])
        prediction: torch.Tensor = self.tail(stream)
        return prediction


class Preconditioned(nn.Module):
    """The denoised sample at ``x`` and sigma, as k-diffusion's ``Denoiser`` gives it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        sigma = timestep[:, None, None]
        total = sigma**2 + DATA**2
        prediction = self.network(sample / total.sqrt(), timestep, state)
        return sample * DATA**2 / total + prediction * sigma * DATA / total.sqrt()


def spec(sigmas: list[float], clip: float | None = None) -> PolicySpec:
    return PolicySpec(SAMPLE, {"state": ObservationSpec((3,))}, edm_table(sigmas, DATA, clip=clip), ChunkSpec(2, 0, 4))


def original(
    network: nn.Module, sigmas: list[float], noise: torch.Tensor, state: torch.Tensor, clip: float
) -> torch.Tensor:
    """Euler's method on dx/dsigma = (x - D) / sigma, in float64."""
    denoiser, x = Preconditioned(network).double(), noise.double() * sigmas[0]
    for sigma, following in pairwise(sigmas):
        denoised = denoiser(x, torch.full((len(x),), sigma, dtype=torch.float64), state.double()).clamp(-clip, clip)
        x = x + (following - sigma) * (x - denoised) / sigma
    return x


@pytest.mark.parametrize("sigmas", [SIGMAS, SIGMAS[:-1], [80.0, 1.0, 0.0]], ids=["to zero", "not to zero", "two steps"])
@pytest.mark.parametrize("clip", [None, 0.1])
def test_the_loop_is_the_original(sigmas: list[float], clip: float | None) -> None:
    rng = np.random.default_rng(0)
    noise, state = rng.standard_normal((3, *SAMPLE), dtype=np.float32), torch.from_numpy(rng.standard_normal((3, 3)))
    run = eager_policy(EDMDenoiser(Network(), sigmas, DATA).eval(), spec(sigmas, clip))
    with Counted() as counted:
        found = run({"state": state.float()}, Noise(noise))
    with torch.no_grad():
        expected = original(Network(), sigmas, torch.from_numpy(noise), state.float(), np.inf if clip is None else clip)
    assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


@pytest.mark.slow
def test_its_blocks_are_found_and_the_artifact_acts_as_the_original(tmp_path: Path) -> None:
    told: dict[str, tuple[str, ...]] = {}
    coarse = ttscompile.compile_denoiser(Preconditioned(Network()).eval(), spec(SIGMAS), explain=told.__setitem__)
    assert len(coarse.blocks) == 1 and "EDMDenoiser and edm_table give finer blocks" in told["OneBlock"][0]
    program = ttscompile.compile_denoiser(EDMDenoiser(Network(), SIGMAS, DATA).eval(), spec(SIGMAS), tmp_path)
    assert len(program.blocks) == 2
    rng = np.random.default_rng(1)
    noise, state = rng.standard_normal((1, *SAMPLE), dtype=np.float32), rng.standard_normal((1, 3), dtype=np.float32)
    found = ttscompile.load(tmp_path).predict_action({"state": state}, noise=Noise(noise))["action_pred"]
    with torch.no_grad(), Counted() as counted:
        expected = original(Network(), SIGMAS, torch.from_numpy(noise), torch.from_numpy(state), np.inf)
    assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


@pytest.mark.parametrize(
    ("sigmas", "data", "message"),
    [
        ([1.0], 0.5, "must fall, and be two or more"),
        ([1.0, 2.0], 0.5, "must fall"),
        ([1.0, float("nan")], 0.5, "must fall"),
        ([1.0, -1.0], 0.5, "not be negative; found -1.0"),
        ([1.0, 0.0], 0.0, "and 0.0"),
    ],
)
def test_levels_that_cannot_be(sigmas: list[float], data: float, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        edm_table(sigmas, data)
