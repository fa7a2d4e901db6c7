"""Twelve tasks of Meta-World, with observations as one policy sees them all: state, goal and which task it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from metaworld.env_dict import ENV_CLS_MAP

from . import Array, Frame

FloatArray = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

TASKS = (
    "reach-v3",
    "push-v3",
    "pick-place-v3",
    "door-open-v3",
    "door-close-v3",
    "drawer-open-v3",
    "button-press-topdown-v3",
    "window-open-v3",
    "faucet-open-v3",
    "handle-press-v3",
    "lever-pull-v3",
    "plate-slide-v3",
)
"""The tasks. The order is that of the one-hot code in an observation, so it belongs to the checkpoint."""

STATE = 18
"""Numbers of one frame in Meta-World's own observation: hand, opening of the gripper, two objects with orientation."""
OBSERVATION = STATE + 3 + 9 + len(TASKS)
"""Do: state, goal, three differences of positions, task."""
REWARD = 10.0
"""Meta-World's reward of a step in which the task is solved; before that it is less."""


def observation(state: npt.ArrayLike, task: int) -> FloatArray:
    """What the policy observes.

    Meta-World's observation is two frames and the goal. The window has frames of its own, so one is left out. The
    differences of positions say nothing new, but spare the network to learn subtraction to a millimetre.

    Args:
        state: ``[39]``, Meta-World's observation with the goal visible; metres.
        task: number of the task in ``TASKS``.

    Returns:
        float32 ``[42]``: the frame (18), goal (3), object - hand, goal - hand and goal - object (9), one-hot task (12).
    """
    array = np.asarray(state, dtype=np.float64)
    frame, goal = array[:STATE], array[-3:]
    hand, thing = frame[:3], frame[4:7]
    code = np.zeros(len(TASKS))
    code[task] = 1.0
    return np.concatenate([frame, goal, thing - hand, goal - hand, goal - thing, code]).astype(np.float32)


def make(task: str) -> Any:
    """Meta-World's environment of a task, with the goal visible and drawn from the seed given to ``seed``."""
    world = ENV_CLS_MAP[task](render_mode="rgb_array", camera_name="corner2")
    # Meta-World leaves these to its benchmark classes, which give out 50 pickled goals a task instead of seeds.
    world._partially_observable = False
    world.__dict__.pop("sawyer_observation_space", None)  # cached by the constructor, while the goal was hidden
    world._freeze_rand_vec = False
    world._set_task_called = True
    world.seeded_rand_vec = True
    return world


class MetaWorld:
    """See ``Environment``. The score is the best reward of a step / ``REWARD``; 1 at success, as Meta-World tells it.

    Attributes:
        state: Meta-World's observation now, ``[39]``.
    """

    title, hz, max_steps = "Meta-World", 80.0, 500  # as Meta-World ends them; the slowest expert needs about 110
    displacements: tuple[int, ...] = (0, 1, 2)

    def __init__(self) -> None:
        self._worlds: dict[str, Any] = {}
        self.state: Float64Array = np.zeros(39)
        self.task, self.done, self.success, self.score = "", True, False, 0.0
        self.measures: dict[str, float] = {}

    def reset(self, seed: int, task: str | None = None) -> None:
        """Start the episode of this seed.

        Args:
            seed: objects and goal are drawn from it.
            task: one of ``TASKS``; None for the one whose number is the seed modulo their count.
        """
        self.task = TASKS[seed % len(TASKS)] if task is None else task
        if self.task not in self._worlds:
            self._worlds[self.task] = make(self.task)
        self._world = self._worlds[self.task]
        self._world.seed(seed)
        self.state, _ = self._world.reset()
        self._steps, self.done, self.success, self.score = 0, False, False, 0.0

    def observe(self) -> Frame:
        """``obs``, float32 ``[42]``; see ``observation``."""
        return {"obs": observation(self.state, TASKS.index(self.task))}

    def step(self, action: Array) -> None:
        """Velocity of the hand and effort of the gripper, ``[4]``, clipped to -1..1, for 0.0125 s."""
        clipped = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        self.state, reward, _, _, info = self._world.step(clipped)
        self._steps += 1
        self.success = self.success or bool(info["success"])
        self.score = 1.0 if self.success else float(np.clip(reward / REWARD, self.score, 1.0))
        self.done = self.success or self._steps == self.max_steps

    def rest(self) -> Array:
        """No velocity."""
        return np.zeros(4, np.float32)

    def picture(self) -> npt.NDArray[np.uint8]:
        """From a corner; the camera hangs upside down. Without a display set MUJOCO_GL=egl."""
        return np.asarray(self._world.render())[::-1, ::-1]

    def close(self) -> None:
        """Nothing more is asked."""
        for world in self._worlds.values():
            world.close()


ENVIRONMENT = MetaWorld
