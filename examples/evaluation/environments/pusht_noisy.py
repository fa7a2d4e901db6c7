"""Push-T with a sensor that errs: every number of a frame is off by some pixels, anew in every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from . import Frame
from .pusht import PushT

NOISE = 4.0
"""Pixels, standard deviation; the demonstrations have none."""


class PushTNoisy(PushT):
    """See ``PushT``, from which only what is observed differs."""

    title = f"Push-T, observed with errors of {NOISE:.0f} px"

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed, which decides the errors, too."""
        super().reset(seed, state)
        self._frame = [seed, 0]

    def observe(self) -> Frame:
        """As ``PushT`` has it, with errors."""
        errors = np.random.default_rng(self._frame).normal(0, NOISE, 20).astype(np.float32)
        return {key: exact + errors for key, exact in super().observe().items()}

    def step(self, action: npt.ArrayLike) -> None:
        """See ``PushT``."""
        super().step(action)
        self._frame[1] += 1


ENVIRONMENT = PushTNoisy
