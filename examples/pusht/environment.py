"""gym-pusht as the policy saw it in training: windows of keypoints in, chunks of target positions out.

The policy observes 20 numbers: the block's nine keypoints (x, y each) and the agent's x, y, in pixels of the 512 x 512
world; a window is the last two frames at 10 Hz. gym-pusht's conventions are those of the demonstrations: the block's
position is the origin of its frame (the middle of the bar's outer edge), not its centre of gravity, and y points down.
Replaying a demonstration's actions in gym-pusht reproduces its states (``tests/examples``).
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from typing import Any

# gym-pusht imports pygame, which prints an advertisement to standard output and wants a display unless told otherwise.
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import gym_pusht  # type: ignore[import-untyped]  # noqa: F401  (registers the environment)
import gymnasium
import numpy as np
import numpy.typing as npt

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

WINDOW = 2
"""To: frames in an observation."""
MAX_STEPS = 300
"""Steps of 0.1 s after which an episode ends, as in the original evaluation."""
SUCCESS_COVERAGE = 0.95
"""Share of the goal that the block must cover; the episode ends there."""


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


class PushT:
    """One episode after another of Push-T, with the history that the observation window needs.

    Attributes:
        states: states so far, the first after reset: ``[5]`` each.
        targets: executed actions: target position of the agent, ``[2]`` pixels each.
        coverages: share of the goal covered after each executed action.
        done: the goal was covered to ``SUCCESS_COVERAGE``, or ``MAX_STEPS`` actions were executed.
    """

    def __init__(self) -> None:
        self._gym = gymnasium.make(
            "gym_pusht/PushT-v0", obs_type="state", max_episode_steps=MAX_STEPS, disable_env_checker=True
        )
        self._frames: deque[FloatArray] = deque(maxlen=WINDOW)
        self.states: list[Float64Array] = []
        self.targets: list[Float64Array] = []
        self.coverages: list[float] = []
        self.done = True

    def reset(self, seed: int, state: Sequence[float] | None = None) -> FloatArray:
        """Start the episode of this seed.

        Args:
            seed: gym-pusht draws the initial state from it.
            state: start in this state instead.

        Returns:
            The first window, float32 ``[2, 20]``: the first frame twice, as the original's runner gives it.
        """
        first, _ = self._gym.reset(seed=seed)
        if state is not None:
            place(self._gym.unwrapped, state)
            first = np.asarray(state, dtype=np.float64)
        self.states, self.targets, self.coverages, self.done = [first], [], [], False
        self._frames.extend([observation(first)] * WINDOW)
        return self.window()

    def window(self) -> FloatArray:
        """The current observation, float32 ``[2, 20]``."""
        return np.stack(self._frames)

    def execute(self, chunk: npt.ArrayLike) -> FloatArray:
        """Execute a chunk of actions, one each 0.1 s, until it ends or the episode is done.

        Args:
            chunk: ``[Ta, 2]`` target positions of the agent, pixels.

        Returns:
            The window after it, float32 ``[2, 20]``.
        """
        for target in np.asarray(chunk, dtype=np.float64):
            if self.done:
                break
            state, _, terminated, truncated, info = self._gym.step(target)
            self.states.append(state)
            self.targets.append(target)
            self.coverages.append(float(info["coverage"]))
            self._frames.append(observation(state))
            self.done = terminated or truncated
        return self.window()
