"""Gymnasium-Robotics' Fetch: an arm reaches, pushes, or picks and places, as the seed says. Written to be copied.

A frame has ``state`` ``[25]`` (gripper and object; of the object zeros where there is none), ``goal`` ``[3]`` and
``task`` ``[3]``, a one-hot vector in the order of ``TASKS``. Actions are ``[4]``: the gripper's displacement and its
opening, -1..1.
"""

from __future__ import annotations

import gymnasium
import gymnasium_robotics
import numpy as np
import numpy.typing as npt

from . import Array, Frame

gymnasium.register_envs(gymnasium_robotics)

TASKS = ("reach", "push", "pick-and-place")
IDS = ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4")
STATE = 25


class Fetch:
    """See ``Environment``. The score is the share of the way to the goal that was covered at best; 1 at success."""

    title, hz, max_steps = "Fetch", 25.0, 50
    displacements: tuple[int, ...] = (0, 1, 2)

    def __init__(self) -> None:
        self._worlds: dict[int, gymnasium.Env[Frame, Array]] = {}
        self.task, self.done, self.success, self.score = "", True, False, 0.0
        self.measures: dict[str, float] = {}

    def reset(self, seed: int) -> None:
        """Start the episode of this seed: task ``seed`` modulo 3."""
        self._number = seed % len(TASKS)
        if self._number not in self._worlds:  # made when it is needed: a world takes 0.1 s
            made = gymnasium.make(IDS[self._number], max_episode_steps=self.max_steps, render_mode="rgb_array")
            self._worlds[self._number] = made
        self._world = self._worlds[self._number]
        self._seen, _ = self._world.reset(seed=seed)
        self.task, self.done, self.success, self.score = TASKS[self._number], False, False, 0.0
        self._start = self._distance()

    def observe(self) -> Frame:
        """See the module."""
        state = self._seen["observation"].astype(np.float32)
        if len(state) < STATE:  # without an object: gripper 3, fingers 2, velocities 3 and 2 of the same
            state = np.concatenate([state[:3], np.zeros(6, np.float32), state[3:5], np.zeros(9, np.float32), state[5:]])
        task = np.eye(len(TASKS), dtype=np.float32)[self._number]
        return {"state": state, "goal": self._seen["desired_goal"].astype(np.float32), "task": task}

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        self._seen, _, _, truncated, info = self._world.step(np.clip(action, -1, 1).astype(np.float32))
        self.success = self.success or bool(info["is_success"])
        covered = 1.0 if self.success else 1.0 - self._distance() / self._start
        self.score = max(self.score, covered)
        self.done = self.success or truncated

    def rest(self) -> Array:
        """No displacement."""
        return np.zeros(4, np.float32)

    def picture(self) -> npt.NDArray[np.uint8]:
        """From the camera of the world; without a display set MUJOCO_GL=egl."""
        return np.asarray(self._world.render())

    def close(self) -> None:
        """Nothing more is asked."""
        for world in self._worlds.values():
            world.close()

    def _distance(self) -> float:
        return float(np.linalg.norm(self._seen["achieved_goal"] - self._seen["desired_goal"]))


ENVIRONMENT = Fetch
