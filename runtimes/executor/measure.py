"""What has to be known of a policy before it drives a robot: how long its calls take, and what they accept."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.config import ObservationSpec

from .clock import Clock
from .settings import ExecutorSettings, Policy


def accepts_prefix(policy: Policy) -> bool:
    """Whether ``predict_action`` has a parameter ``prefix``, by that name."""
    return "prefix" in inspect.signature(policy.predict_action).parameters


def neutral_observation(specs: dict[str, ObservationSpec]) -> dict[str, npt.NDArray[Any]]:
    """An observation of one stream that the normaliser maps to 0."""
    made: dict[str, npt.NDArray[Any]] = {}
    for key, spec in specs.items():
        zeros = np.zeros((1, *spec.shape), np.float32)
        made[key] = (zeros if spec.normalizer is None else spec.normalizer.unnormalize(zeros)).astype(spec.dtype)
    return made


def measure_latencies(
    policy: Policy, clock: Clock, settings: ExecutorSettings, plans: Sequence[str]
) -> dict[str, list[float]]:
    """Seconds of each measured call of each plan, after the warm-up.

    The caller resets the policy before and after.
    """
    obs = neutral_observation(dict(policy.info.observation))
    latencies: dict[str, list[float]] = {}
    for plan in plans:
        for _ in range(settings.warm_up):
            policy.predict_action(obs, plan=plan)
        latencies[plan] = []
        for _ in range(settings.measured_calls):
            start = clock.now()
            policy.predict_action(obs, plan=plan)
            latencies[plan].append(clock.now() - start)
    return latencies
