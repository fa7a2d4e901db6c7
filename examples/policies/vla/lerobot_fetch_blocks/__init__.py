"""``fetch_blocks`` as an environment of LeRobot's own commands.

    PYTHONPATH=examples/policies/vla MUJOCO_GL=osmesa lerobot-eval --env.discover_packages_path=lerobot_fetch_blocks \
        --env.type=fetch_blocks --policy.path=DIR --seed=100000 --eval.n_episodes=120 --eval.batch_size=12

``DIR`` is the policy or its compiled artifact. Seeds from 100000 on are those of ``examples/evaluation``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

sys.path.insert(1, str(Path(__file__).parents[3] / "evaluation"))

from environments import environment_class
from environments.fetch_blocks import SIZE, FetchBlocks

CAMERAS = ("front", "wrist")
Observation = dict[str, Any]


class World(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """What LeRobot asks of an environment; all else is ``FetchBlocks``.

    Args:
        name: of ``environments``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(FetchBlocks.hz)}  # noqa: RUF012  # gymnasium's own
    render_mode = "rgb_array"

    def __init__(self, name: str) -> None:
        self._world: Any = environment_class(name)()
        self._max_episode_steps = self._world.max_steps
        picture = Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        self.observation_space = Dict(
            {"pixels": Dict(dict.fromkeys(CAMERAS, picture)), "agent_pos": Box(-np.inf, np.inf, (4,), np.float32)}
        )
        self.action_space = Box(-np.inf, np.inf, (4,), np.float32)

    @property
    def task(self) -> str:
        """One of ``TASKS``."""
        return str(self._world.task)

    @property
    def task_description(self) -> str:
        """What the policy is told."""
        return str(self._world.instruction)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of this seed."""
        super().reset(seed=seed, options=options)
        self._world.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        return self._observed(), {"is_success": False}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for 0.04 s."""
        world = self._world
        world.step(action)
        ended = world.done and not world.success
        return self._observed(), world.score, world.success, ended, {"is_success": world.success}

    def _observed(self) -> Observation:
        frame = self._world.observe()
        pictures = {
            name: np.moveaxis(np.round(frame[f"observation.images.{name}"] * 255).astype(np.uint8), 0, -1)
            for name in CAMERAS
        }
        return {"pixels": pictures, "agent_pos": frame["observation.state"]}

    def render(self) -> npt.NDArray[np.uint8]:
        """The world from the fixed camera."""
        return np.asarray(self._world.picture())

    def close(self) -> None:
        """Nothing more is asked."""
        self._world.close()


def _features() -> dict[str, PolicyFeature]:
    cameras = {f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3)) for name in CAMERAS}
    state, action = PolicyFeature(FeatureType.STATE, (4,)), PolicyFeature(FeatureType.ACTION, (4,))
    return {**cameras, "agent_pos": state, "action": action}


def _names() -> dict[str, str]:
    cameras = {f"pixels/{name}": f"observation.images.{name}" for name in CAMERAS}
    return {**cameras, "agent_pos": "observation.state", "action": "action"}


@EnvConfig.register_subclass("fetch_blocks")
@dataclass
class FetchBlocksConfig(EnvConfig):  # type: ignore[misc]  # lerobot has no types where ours are checked
    """``--env.type=fetch_blocks``; ``--env.task`` is the world, or ``fetch-blocks:NAME`` with a disturbance."""

    task: str | None = "fetch-blocks"
    fps: int = round(FetchBlocks.hz)
    features: dict[str, PolicyFeature] = field(default_factory=_features)
    features_map: dict[str, str] = field(default_factory=_names)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing is asked of gymnasium's registry."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, SyncVectorEnv]]:
        """One suite of one task: the seed of an episode says what is asked in it.

        Args:
            n_envs: episodes at a time, in this process.
            use_async_envs: not used.
        """
        name = self.task or "fetch-blocks"
        makes = [freeze_after_episode_end(lambda: World(name)) for _ in range(n_envs)]
        return {self.type: {0: SyncVectorEnv(makes, autoreset_mode=AutoresetMode.NEXT_STEP)}}
