"""A robot that never moves, may disappear, and ``lerobot-rollout`` with it. Needs lerobot."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig

from tests.plugins.lerobot_saved import PIXELS

JOINTS = ("x.pos", "y.pos")


@RobotConfig.register_subclass("still_robot")
@dataclass
class StillRobotConfig(RobotConfig):
    """``log`` is the file that gets a line for each action; after so many frames nothing answers any more."""

    log: str = ""
    frames: int = 10**9


class StillRobot(Robot):
    """Two joints and a camera ``top``."""

    config_class = StillRobotConfig
    name = "still_robot"

    def __init__(self, config: StillRobotConfig) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {}
        self.is_connected = False
        self.is_calibrated = True
        self._log, self._left = Path(config.log), config.frames

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**self.action_features, "top": (PIXELS, PIXELS, 3)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, Any]:
        self._left -= 1
        if self._left < 0:
            raise ConnectionError("the robot does not answer any more")
        return {**dict.fromkeys(JOINTS, 0.1), "top": np.full((PIXELS, PIXELS, 3), 99, np.uint8)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        with self._log.open("a") as file:
            file.write(" ".join(str(float(action[joint])) for joint in JOINTS) + "\n")
        return action

    def disconnect(self) -> None:
        self.is_connected = False


if __name__ == "__main__":
    from lerobot.scripts.lerobot_rollout import main

    main()
