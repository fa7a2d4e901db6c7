"""A policy whose calls take as long as a test says."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ttscompile.runtimes.policy import CompiledPolicy


class Timed:
    """A policy whose calls take as long as they are told to; beside other work some of them take ten times that.

    Args:
        policy: makes the calls.
        seconds: of a call, by plan; that of ``dense`` for plans that are not named.
        busy: share of the calls that other work slows down.
    """

    def __init__(self, policy: CompiledPolicy, seconds: Mapping[str, float], busy: float) -> None:
        self._policy, self._seconds, self._busy = policy, seconds, busy
        self._draw = np.random.default_rng(0)
        self.now, self.calls = 0.0, 0
        self.reset, self.forget_frames = policy.reset, policy.forget_frames

    def predict_action(self, obs: Any, *, noise: Any, plan: str) -> Any:
        self.calls += 1
        slowed = 10 if self._draw.random() < self._busy else 1
        self.now += self._seconds.get(plan, self._seconds["dense"]) * slowed
        return self._policy.predict_action(obs, noise=noise, plan="schedule" if plan == "uniform" else plan)

    @property
    def last_report(self) -> Any:
        return self._policy.last_report
