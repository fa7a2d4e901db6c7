"""The policy that was compiled, as LeRobot runs it: what acts in shadow mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor


class Original:
    """A policy of LeRobot's between its processors, so that it takes and gives the robot's units, as a compiled one.

    Args:
        path: the directory that lerobot saved it in, or a repository of the hub.
    """

    def __init__(self, path: str | Path) -> None:
        config = PreTrainedConfig.from_pretrained(path)
        self._policy = get_policy_class(config.type).from_pretrained(path, config=config).eval()
        device = {"device_processor": {"device": config.device}}
        self._before, self._after = make_pre_post_processors(config, str(path), preprocessor_overrides=device)

    def reset(self) -> None:
        """A new episode."""
        self._policy.reset()

    def select_action(self, batch: dict[str, Any]) -> Tensor:
        """The next action ``[B, Da]``."""
        return self._answered("select_action", batch)

    def predict_action_chunk(self, batch: dict[str, Any]) -> Tensor:
        """A chunk of actions ``[B, T, Da]``."""
        return self._answered("predict_action_chunk", batch)

    def _answered(self, name: str, batch: dict[str, Any]) -> Tensor:
        with torch.inference_mode():
            action: Tensor = self._after(getattr(self._policy, name)(self._before(batch)))
        return action
