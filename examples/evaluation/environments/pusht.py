"""gym-pusht as the policy saw it in training: keypoints in, target positions out.

The policy observes 20 numbers: the block's nine keypoints (x, y each) and the agent's x, y, in pixels of the 512 x 512
world; an action is a position that the agent is to move to, for 0.1 s. gym-pusht's conventions are those of the
demonstrations: the block's position is the origin of its frame (the middle of the bar's outer edge), not its centre of
gravity, and y points down. Replaying a demonstration's actions reproduces its states (``tests/examples``).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

# gym-pusht imports pygame, which prints an advertisement to standard output and wants a display unless told otherwise.
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import numpy as np
import numpy.typing as npt
from gym_pusht.envs.pusht import PushTEnv, pymunk_to_shapely  # type: ignore[import-untyped]
from gymnasium.wrappers import TimeLimit
from pymunk import Vec2d

from . import Array, Frame

FloatArray = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

KEYPOINTS: Float64Array = np.array(
    [
        [9.268611, 90.022804],
        [-60.992165, -1.1871753],
        [60.907116, -1.3928658],
        [-0.27046284, 25.543589],
        [-14.063669, 122.81129],
        [39.000347, 32.860786],
        [-39.954643, 32.734173],
        [-16.821692, 62.872383],
        [23.54105, -1.7001413],
    ]
)
"""``[9, 2]``: the keypoints in the block's frame, in pixels, as the published demonstrations have them."""

SUCCESS_COVERAGE = 0.95
"""Share of the goal that the block must cover; the episode ends there."""
PICTURE = 512
"""Pixels of gym-pusht's own drawing: one a unit of the world."""


def keypoints(position: npt.ArrayLike, angle: npt.ArrayLike) -> Float64Array:
    """Keypoints in the world, ``R(angle) local + position``.

    Args:
        position: ``[..., 2]`` pixels.
        angle: ``[...]`` radians.

    Returns:
        float64 ``[..., 9, 2]`` pixels.
    """
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    return np.asarray(np.einsum("...ij,kj->...ki", rotation, KEYPOINTS) + np.asarray(position)[..., None, :])


def observation(state: npt.ArrayLike) -> FloatArray:
    """What the policy observes in a state.

    Args:
        state: ``[..., 5]``: agent x, y, block x, y (pixels), block angle (radians).

    Returns:
        float32 ``[..., 20]``: the keypoints' x, y in order, then the agent's x, y.
    """
    array = np.asarray(state, dtype=np.float64)
    points = keypoints(array[..., 2:4], array[..., 4])
    return np.concatenate([points.reshape(*array.shape[:-1], 18), array[..., :2]], axis=-1).astype(np.float32)


def place(body_world: Any, state: npt.ArrayLike) -> None:
    """Put agent and block of an unwrapped gym-pusht environment exactly into a state, at rest.

    gym-pusht's own ``reset_to_state`` keeps a historical order of assignments, after which the state is another one:
    the angle turns the block about its centre of gravity and so has to be set before the position.

    Args:
        body_world: ``environment.unwrapped`` of gym-pusht, after a reset.
        state: ``[5]`` as in ``observation``.
    """
    agent_x, agent_y, block_x, block_y, angle = (float(value) for value in np.asarray(state))
    body_world.agent.position = (agent_x, agent_y)
    body_world.agent.velocity = (0.0, 0.0)
    body_world.block.angle = angle
    body_world.block.position = (block_x, block_y)
    body_world.space.reindex_shapes_for_body(body_world.agent)
    body_world.space.reindex_shapes_for_body(body_world.block)


class QuickPushT(PushTEnv):  # type: ignore[misc]
    """gym-pusht, faster and with the same numbers: polygons are made of the goal once, and of a block that moved."""

    _goal: tuple[tuple[float, ...], Any] = (), None
    _covered: tuple[tuple[float, ...], float] = (), 0.0

    def _get_coverage(self) -> float:
        goal, block = tuple(self.goal_pose), (*self.block.position, self.block.angle)
        if goal != self._goal[0]:
            self._goal = goal, pymunk_to_shapely(self.get_goal_pose_body(self.goal_pose), self.block.shapes)
            self._covered = (), 0.0
        if block != self._covered[0]:
            there = pymunk_to_shapely(self.block, self.block.shapes)
            self._covered = block, self._goal[1].intersection(there).area / self._goal[1].area
        return self._covered[1]


class PushT:
    """See ``Environment``. The score is the original's reward: best coverage of the goal / ``SUCCESS_COVERAGE``.

    Attributes:
        state: ``[5]`` now, as in ``observation``.
        coverage: share of the goal that was covered at best.
    """

    title, hz, max_steps, task = "Push-T", 10.0, 300, ""
    displacements: tuple[int, ...] = ()

    def __init__(self) -> None:
        world = QuickPushT("state", "rgb_array", visualization_width=PICTURE, visualization_height=PICTURE)
        self._gym: Any = TimeLimit(world, self.max_steps)
        self.state: Float64Array = np.zeros(5)
        self.coverage, self.done = 0.0, True

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed.

        Args:
            seed: gym-pusht draws the initial state from it.
            state: start in this state instead.
        """
        self.state, _ = self._gym.reset(seed=seed)
        self._gym.unwrapped._last_action = None  # gym-pusht would go on drawing that of the episode before
        if state is not None:
            place(self._gym.unwrapped, state)
            self.state = np.asarray(state, dtype=np.float64)
        self.coverage, self.done = 0.0, False

    @property
    def success(self) -> bool:
        """Whether the goal was covered to more than ``SUCCESS_COVERAGE``."""
        return self.coverage > SUCCESS_COVERAGE

    @property
    def score(self) -> float:
        """Best coverage as a share of what counts as success, at most 1."""
        return min(self.coverage / SUCCESS_COVERAGE, 1.0)

    @property
    def measures(self) -> dict[str, float]:
        """The coverage as it is."""
        return {"best coverage": self.coverage}

    def observe(self) -> Frame:
        """``obs`` or ``observation.state``, as LeRobot calls it: float32 ``[20]``."""
        seen = observation(self.state)
        return {"obs": seen, "observation.state": seen}

    def step(self, action: npt.ArrayLike) -> None:
        """Send the agent towards a position ``[2]``, pixels, for 0.1 s."""
        target = Vec2d(*np.asarray(action, dtype=np.float64).tolist())  # cheaper than an array of two numbers
        self.state, _, terminated, truncated, info = self._gym.step(target)
        self.coverage = max(self.coverage, float(info["coverage"]))
        self.done = terminated or truncated

    def rest(self) -> Array:
        """Where the agent is."""
        return self.state[:2].astype(np.float32)

    def picture(self) -> npt.NDArray[np.uint8]:
        """``[512, 512, 3]``; a red cross is where the agent was last sent."""
        return np.asarray(self._gym.render())

    def close(self) -> None:
        """Nothing more is asked."""
        self._gym.close()


ENVIRONMENT = PushT
