"""Small denoisers to calibrate, and recordings for them."""

from pathlib import Path

import numpy as np
import torch
from torch import nn

import ttscompile
from tests.once import Once
from ttscompile import Affine, ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.calibration.pipeline import CalibrationResult

STEPS, HORIZON, CHANNELS, WIDTH, LAYERS = 10, 8, 2, 32, 3


class Mixer(nn.Module):
    """A residual network whose blocks mix tokens or channels, and that sees observation and time.

    Args:
        seed: of the weights.
        linear: leave out every nonlinearity.
    """

    def __init__(self, seed: int, linear: bool = False) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.linear = linear
        self.embed = nn.Linear(CHANNELS, WIDTH)
        self.encode = nn.Sequential(
            nn.Linear(6, WIDTH), nn.Identity() if linear else nn.GELU(), nn.Linear(WIDTH, WIDTH)
        )
        self.time = nn.Embedding(STEPS, WIDTH)
        self.mix = nn.ModuleList(nn.Linear(HORIZON, HORIZON) for _ in range(LAYERS))
        self.wide = nn.ModuleList(nn.Linear(WIDTH, 4 * WIDTH) for _ in range(LAYERS))
        self.narrow = nn.ModuleList(nn.Linear(4 * WIDTH, WIDTH) for _ in range(LAYERS))
        self.head = nn.Linear(WIDTH, CHANNELS)

    def _active(self, x: torch.Tensor) -> torch.Tensor:
        return x if self.linear else nn.functional.gelu(nn.functional.layer_norm(x, x.shape[-1:]))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        condition = self.encode(obs.flatten(1)).unsqueeze(1)
        time = self.time(timestep).unsqueeze(1)
        h = self.embed(sample)
        for mix, wide, narrow in zip(self.mix, self.wide, self.narrow, strict=True):
            h = h + mix(self._active(h + time).transpose(1, 2)).transpose(1, 2)
            h = h + narrow(self._active(wide(h + condition)))
        return self.head(h)


def spec(noise: float = 0.05, clip: float | None = 1.0) -> PolicySpec:
    """Each step goes a quarter of the way to the predicted sample."""
    columns = {name: np.zeros(STEPS, np.float32) for name in SamplerTable.COLUMNS}
    columns["out_to_x0"] += 1
    columns["x0_to_next"] += 0.25
    columns["sample_to_next"] += 0.75
    columns["noise_to_next"][:-1] += noise
    table = SamplerTable("toy", np.arange(STEPS)[::-1].copy(), clip=clip, **columns)
    actions = Affine(np.array([0.5, 2.0], np.float32), np.array([0.1, -0.3], np.float32))
    observation = Affine(np.array([0.5, 1.0, 2.0], np.float32), np.array([0.0, 0.1, -0.1], np.float32))
    return PolicySpec(
        sample=(HORIZON, CHANNELS),
        observations={"obs": ObservationSpec((2, 3), observation)},
        sampler=table,
        chunk=ChunkSpec(CHANNELS, 1, 5, actions, ranged=False),  # recordings may be anywhere
    )


def compiled(once: Once, precision: str = "fp32") -> Path:
    """The artifact of ``Mixer(0)``, not calibrated: made once a run, so a test that changes it takes a copy."""
    module = Mixer(0).eval()
    return once.compiled(
        f"mixer {precision}", lambda path: ttscompile.compile_denoiser(module, spec(), path, precision=precision)
    )[0]


def record(path: Path, episodes: int = 6, seed: int = 0) -> Path:
    """Random walks of the observation, a different length each, as a trajectory file."""
    draw = np.random.default_rng(seed)
    lengths = [5 + i % 3 for i in range(episodes)]
    walks = [np.cumsum(draw.standard_normal((n, 2, 3)), 0).astype(np.float32) for n in lengths]
    np.savez(path, obs=np.concatenate(walks), episode_ends=np.cumsum(lengths))
    return path


def whole_steps(directory: Path, recording: Path) -> Path:
    """The artifact with a schedule that computes two of its ten steps."""
    ttscompile.calibrate(directory, [recording], 0.8, learn=("interval",), progress=False)
    return directory


def errors(result: CalibrationResult) -> dict[str, float]:
    """By plan, of those that were judged with the noise of the dense policy."""
    return {name: score.error for name, score in result.plans.items() if score.error is not None}
