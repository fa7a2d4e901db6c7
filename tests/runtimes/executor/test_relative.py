"""Seams between chunks whose actions are relative to states that differ: the robot's actions go on as they should."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, DirectDenoiser, ExecutorSettings, ObservationSpec, PolicySpec
from ttscompile.core.spec import Affine, Relative

from .simulation import actions_of

HZ, HORIZON, EXECUTED, SLOPE = 10.0, 10, 6, 0.25
SPEC = PolicySpec(
    sample=(HORIZON, 1),
    observations={"obs": ObservationSpec((1, 2))},
    sampler=ttscompile.direct_table(),
    chunk=ChunkSpec(
        1, 0, EXECUTED, Affine(np.array([0.5]), np.array([0.1])), ranged=False, relative=Relative("obs", (0,))
    ),
)


class Ramp(nn.Module):
    """Where a path of its own goes from here, less where the robot is: the observation is that place and the time."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = nn.Parameter(torch.arange(float(HORIZON)))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        place, now = obs[:, :, :1], obs[:, :, 1:]
        return ((now + self.steps[:, None]) * SLOPE - place) * 0.5 + 0.1


def compiled(once: Once, relative: bool) -> Path:
    spec = SPEC if relative else replace(SPEC, chunk=replace(SPEC.chunk, relative=None))
    name, network = f"a ramp, relative: {relative}", DirectDenoiser(Ramp()).eval()
    return once.compiled(name, lambda to: ttscompile.compile_denoiser(network, spec, to))[0]


def played(path: Path, settings: ExecutorSettings) -> np.ndarray:
    """Actions of a robot that is somewhere else at every tick."""
    rng, policy = np.random.default_rng(0), ttscompile.load(path, seed=0)
    return actions_of(policy, settings, HZ, 0.2, lambda tick: [rng.uniform(-9, 9), tick], 4 * EXECUTED)[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        ExecutorSettings(seam="replace"),
        ExecutorSettings(seam="blend", blend_steps=3),
        ExecutorSettings(seam="ensemble"),
    ],
    ids=["replace", "blend", "ensemble"],
)
def test_the_actions_do_not_jump_with_the_state(once: Once, settings: ExecutorSettings) -> None:
    found = played(compiled(once, True), settings)
    assert len(found) == 4 * EXECUTED
    np.testing.assert_allclose(np.diff(found), SLOPE, rtol=0, atol=1e-4)
    assert np.abs(np.diff(played(compiled(once, False), settings))).max() > 1, "the state is what would jump"
