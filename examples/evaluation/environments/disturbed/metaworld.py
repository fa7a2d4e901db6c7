"""Meta-World: somebody moves the block that is to be pushed, or picked up."""

from __future__ import annotations

import numpy as np

from .. import Array
from ..metaworld import MetaWorld

TASKS = ("push-v3", "pick-place-v3")
"""Those that have a block."""
WHEN = (10, 40)
"""Actions after which it is moved, from and below."""
LEAST, ROOM = 0.08, 0.1
"""Metres that it is moved, at least, and that the hand is away from where it was and will be."""


class MetaWorldMoved(MetaWorld):
    """See ``MetaWorld``. The block is put elsewhere among the places where episodes begin, while the hand is away.

    Attributes:
        moves: whether it is; a class in which it is not has the same episodes without that.
    """

    title = "Meta-World, the block is moved"
    moves = True

    def reset(self, seed: int, task: str | None = None) -> None:
        """Start the episode of this seed, which decides when and where to the block is moved, too."""
        super().reset(seed, TASKS[seed % len(TASKS)] if task is None else task)
        self._random, self.moved_at = np.random.default_rng((seed, 2)), -1
        self._due = int(self._random.integers(*WHEN))
        self.measures = {"moved at": -1.0}

    def step(self, action: Array) -> None:
        """See ``MetaWorld``."""
        super().step(action)
        if self.moved_at < 0 and self._steps >= self._due and not self.done:
            self._move()

    def _move(self) -> None:
        hand, block, space = self.state[:3], self.state[4:7], self._world._random_reset_space
        for _ in range(100):
            place = np.array([*self._random.uniform(space.low[:2], space.high[:2]), block[2]])
            from_hand = min(np.linalg.norm(place - hand), np.linalg.norm(block - hand))
            if from_hand > ROOM and np.linalg.norm(place - block) > LEAST:
                break
        else:
            return  # there is no room; perhaps after the next action
        self.moved_at = self._steps
        self.measures = {"moved at": float(self._steps)}
        if self.moves:
            self._world._set_obj_xyz(place)
            self.state = self._world._get_obs()


DISTURBED = {"moved": MetaWorldMoved}
