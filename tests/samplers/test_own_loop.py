"""A loop that is no scheduler of diffusers, in the form that ``docs/howto/own-denoiser.md`` asks for."""

from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from ttscompile.errors import SpecError
from ttscompile.samplers.table import sampler_table

LEVELS = [(0.75, 0.3), (0.5, 0.6), (0.25, 0.9), (0.0, 1.0)]
"""What the network is given, and alpha; the last is where the loop ends."""


class OwnLoop:
    """Levels of one's own, and noise."""

    config: ClassVar[dict[str, Any]] = {}

    def set_timesteps(self, steps: int) -> None:
        self.timesteps = torch.tensor([t for t, _ in LEVELS[:steps]])

    def step(self, out: torch.Tensor, t: torch.Tensor, x: torch.Tensor, generator: Any = None) -> SimpleNamespace:
        k = [level for level, _ in LEVELS].index(t.item())
        a, following = LEVELS[k][1], LEVELS[k + 1][1]
        clean = (a * x - (1 - a * a) ** 0.5 * out).clamp(-2, 2)
        noise = 0.1 * k * torch.randn(x.shape, generator=generator, dtype=x.dtype)
        return SimpleNamespace(prev_sample=following * clean + (1 - a) * x + noise, pred_original_sample=clean)


class TwoSchedules(OwnLoop):
    """Some numbers of the sample have another step than the others."""

    def step(self, out: torch.Tensor, t: torch.Tensor, x: torch.Tensor, generator: Any = None) -> SimpleNamespace:
        made = super().step(out, t, x, generator)
        made.prev_sample[..., 0] *= 0.5
        return made


def test_its_table_is_measured() -> None:
    table, alpha = sampler_table(OwnLoop(), 3), np.array([0.3, 0.6, 0.9])
    assert (table.name, table.timesteps.tolist(), table.clip) == ("OwnLoop", [0.75, 0.5, 0.25], 2.0)
    expected = [alpha, -np.sqrt(1 - alpha**2), np.array([0.6, 0.9, 1.0]), 1 - alpha, np.zeros(3), np.arange(3) / 10]
    found = np.stack([getattr(table, column) for column in table.COLUMNS])
    np.testing.assert_allclose(found, np.stack(expected), rtol=1e-6, atol=1e-7)


def test_numbers_that_have_another_step_are_refused() -> None:
    with pytest.raises(SpecError, match="sampler TwoSchedules does not have the form"):
        sampler_table(TwoSchedules(), 3)
