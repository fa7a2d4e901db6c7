"""Push-T from where no recording begins, with a sensor that errs, and five times as long."""

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
GOALS = 5
"""One after the other, in a long episode."""


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


class PushTLong(PushT):
    """See ``PushT``: five of its episodes in one.

    Where the goal is reached, or as many actions as it has were in vain, the block is put elsewhere and all goes on:
    nobody resets the policy, and the agent stays where it is. The score is the mean of the five.
    """

    title, max_steps = f"Push-T, {GOALS} goals in a row", GOALS * PushT.max_steps

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed, which decides where the block is put, too."""
        super().reset(seed, state)
        self._places, self._begun, self._taken = np.random.default_rng((seed, 1)), 0, 0
        self._scores, self._reached = 0.0, 0

    @property
    def success(self) -> bool:
        """Whether all goals were reached."""
        return self._reached == GOALS

    @property
    def score(self) -> float:
        """Mean over the goals; 0 of those that are still to come."""
        return (self._scores + (0.0 if self.done else super().score)) / GOALS

    @property
    def measures(self) -> dict[str, float]:
        """How many goals were reached."""
        return {"goals": float(self._reached)}

    def step(self, action: npt.ArrayLike) -> None:
        """See ``PushT``."""
        super().step(action)
        self._taken += 1
        if not self.done and self._taken < PushT.max_steps:
            return
        self._scores, self._reached = self._scores + super().score, self._reached + super().success
        self._begun, self._taken = self._begun + 1, 0
        self.done = self._begun == GOALS
        if not self.done:
            block, angle = self._places.uniform(*RECORDED, 2), self._places.uniform(-np.pi, np.pi)
            super().reset(int(self._places.integers(2**31)), [*self.state[:2].tolist(), *block.tolist(), float(angle)])


DISTURBED = {"edge": PushTEdge, "long": PushTLong, "noisy": PushTNoisy}
