"""Twelve tasks of Meta-World, with observations as one policy sees them all: state, goal and which task it is."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt
from metaworld.env_dict import ENV_CLS_MAP  # type: ignore[import-untyped]

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

WINDOW = 2
"""To: frames in an observation."""
MAX_STEPS = 200
"""Steps of 0.0125 s of simulated time after which an episode ends. The slowest expert needs about 110."""
STATE = 18
"""Numbers of one frame in Meta-World's own observation: hand, opening of the gripper, two objects with orientation."""
OBSERVATION = STATE + 3 + 9 + len(TASKS)
"""Do: state, goal, three differences of positions, task."""


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
    world = ENV_CLS_MAP[task]()
    # Meta-World leaves these to its benchmark classes, which give out 50 pickled goals a task instead of seeds.
    world._partially_observable = False
    world.__dict__.pop("sawyer_observation_space", None)  # cached by the constructor, while the goal was hidden
    world._freeze_rand_vec = False
    world._set_task_called = True
    world.seeded_rand_vec = True
    return world


class MetaWorld:
    """One episode after another of Meta-World, with the history that the observation window needs.

    Attributes:
        task: of the current episode.
        states: Meta-World's observations so far, the first after reset: ``[39]`` each.
        actions: executed actions: velocity of the hand and effort of the gripper, ``[4]`` each, -1..1.
        success: whether Meta-World said so after one of the actions.
        done: success, or ``MAX_STEPS`` actions were executed.
    """

    def __init__(self) -> None:
        self._worlds: dict[str, Any] = {}
        self._frames: deque[FloatArray] = deque(maxlen=WINDOW)
        self.task = ""
        self.states: list[Float64Array] = []
        self.actions: list[Float64Array] = []
        self.success = False
        self.done = True

    def reset(self, seed: int, task: str | None = None) -> FloatArray:
        """Start the episode of this seed.

        Args:
            seed: objects and goal are drawn from it.
            task: one of ``TASKS``; None for the one whose number is the seed modulo their count.

        Returns:
            The first window, float32 ``[2, 42]``: the first frame twice.
        """
        self.task = TASKS[seed % len(TASKS)] if task is None else task
        if self.task not in self._worlds:
            self._worlds[self.task] = make(self.task)
        world = self._worlds[self.task]
        world.seed(seed)
        state, _ = world.reset()
        self.states, self.actions, self.success, self.done = [state], [], False, False
        self._frames.extend([observation(state, TASKS.index(self.task))] * WINDOW)
        return self.window()

    def window(self) -> FloatArray:
        """The current observation, float32 ``[2, 42]``."""
        return np.stack(self._frames)

    def step(self, action: npt.ArrayLike) -> None:
        """Execute one action, ``[4]``, which is clipped to -1..1."""
        clipped = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        state, _, _, _, info = self._worlds[self.task].step(clipped)
        self.states.append(state)
        self.actions.append(clipped)
        self._frames.append(observation(state, TASKS.index(self.task)))
        self.success = self.success or bool(info["success"])
        self.done = self.success or len(self.actions) >= MAX_STEPS

    def execute(self, chunk: npt.ArrayLike) -> FloatArray:
        """Execute a chunk of actions until it ends or the episode is done.

        Args:
            chunk: ``[Ta, 4]``.

        Returns:
            The window after it, float32 ``[2, 42]``.
        """
        for action in np.asarray(chunk):
            if self.done:
                break
            self.step(action)
        return self.window()
