"""Push-T from where no recording begins, with a sensor that errs, five times as long, and with the block moved."""

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
WHEN, FURTHER, TURNED, ROOM = (30, 90), 80.0, 0.6, 40.0
"""Actions after which somebody moves the block, from and below; pixels by which, radians at most, and pixels from all
keypoints to the agent."""


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


class PushTMoved(PushT):
    """See ``PushT``. Somebody moves the block while the agent is away from it; the score is what is covered afterwards.

    Attributes:
        moves: whether it is moved; a class in which it is not has the same episodes without that.
    """

    title = "Push-T, the block is moved"
    moves = True

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed, which decides when and where to the block is moved, too."""
        super().reset(seed, state)
        self._random, self._taken, self.moved_at = np.random.default_rng((seed, 2)), 0, -1
        self._due = int(self._random.integers(*WHEN))

    @property
    def score(self) -> float:
        """See ``PushT``; 0 before the block is moved, unless the goal is reached before."""
        return super().score if self.moved_at >= 0 or self.success else 0.0

    @property
    def measures(self) -> dict[str, float]:
        """After how many actions it was moved; -1 for not yet."""
        return {"moved at": float(self.moved_at)}

    def step(self, action: npt.ArrayLike) -> None:
        """See ``PushT``."""
        super().step(action)
        self._taken += 1
        if self.moved_at < 0 and self._taken >= self._due and not self.done:
            self._move()

    def _move(self) -> None:
        agent, block, angle = self.state[:2], self.state[2:4], float(self.state[4])
        for _ in range(100):
            way = self._random.uniform(-np.pi, np.pi)
            to, turned = block + FURTHER * np.array([np.cos(way), np.sin(way)]), self._random.uniform(-TURNED, TURNED)
            points = np.concatenate([keypoints(block, angle), keypoints(to, angle + turned)])
            inside = points[9:].min() > NEAREST and points[9:].max() < 512 - NEAREST
            if inside and np.linalg.norm(points - agent, axis=1).min() > ROOM:
                break
        else:
            return  # there is no room; perhaps after the next action
        self.moved_at, self.coverage = self._taken, 0.0
        if self.moves:
            world = self._gym.unwrapped
            self.state = np.array([*agent, *to, angle + turned])
            world.block.angle = float(self.state[4])
            world.block.position = (float(to[0]), float(to[1]))
            world.block.velocity, world.block.angular_velocity = (0.0, 0.0), 0.0
            world.space.reindex_shapes_for_body(world.block)


DISTURBED = {"edge": PushTEdge, "long": PushTLong, "moved": PushTMoved, "noisy": PushTNoisy}
