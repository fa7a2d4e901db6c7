"""Push-T from where no recording begins, and with a sensor that errs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .. import Frame
from ..pusht import PushT, keypoints

NEAREST, RECORDED = 20.0, (100.0, 400.0)
"""Pixels: every keypoint is that far from the walls; where gym-pusht puts the block, in x and in y."""
NOISE = 4.0
"""Pixels, standard deviation of what every number of a frame is off by; the demonstrations have none."""


class PushTEdge(PushT):
    """See ``PushT``, from which only the start differs."""

    title = "Push-T, begun at the edge"

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed, with the block outside of ``RECORDED`` in x, in y or in both."""
        super().reset(seed, begun_at_the_edge(seed) if state is None else state)


def begun_at_the_edge(seed: int) -> list[float]:
    """The state ``[5]`` that an episode starts from."""
    rng = np.random.default_rng(seed)
    while True:
        agent, block, angle = rng.uniform(50, 450, 2), rng.uniform(0, 512, 2), rng.uniform(-np.pi, np.pi)
        points = keypoints(block, angle)
        inside = points.min() > NEAREST and points.max() < 512 - NEAREST
        if inside and (block.min() < RECORDED[0] or block.max() > RECORDED[1]):
            return [*agent.tolist(), *block.tolist(), float(angle)]


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


DISTURBED = {"edge": PushTEdge, "noisy": PushTNoisy}
