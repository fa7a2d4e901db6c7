"""What has to be known of a policy before it drives a robot: how long its calls take, and what they accept."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import ChunkSpec, FloatArray, ObservationSpec
from ttscompile.measure.timer import Timer, Times

from .clock import Clock
from .settings import ExecutorSettings, Policy


def prefix_refusal(policy: Policy) -> str | None:
    """Why a policy cannot be given the actions that are committed; None if it can.

    It can if ``predict_action`` has a parameter ``prefix``, by that name, and the policy itself has nothing against it.
    """
    if "prefix" not in inspect.signature(policy.predict_action).parameters:
        return f"{type(policy).__name__} does not."
    refusal: str | None = getattr(policy.info, "prefix_refusal", None)
    return None if refusal is None else f"this one does not: {refusal}"


def neutral_observation(specs: dict[str, ObservationSpec]) -> dict[str, npt.NDArray[Any]]:
    """An observation of one stream that the normaliser maps to 0."""
    made: dict[str, npt.NDArray[Any]] = {}
    for key, spec in specs.items():
        zeros = np.zeros((1, *spec.shape), np.float32)
        made[key] = (zeros if spec.normalizer is None else spec.normalizer.unnormalize(zeros)).astype(spec.dtype)
    return made


def neutral_action(chunk: ChunkSpec) -> FloatArray:
    """One action of one stream, ``[1, 1, Da]``, that the normaliser maps to 0."""
    zeros = np.zeros((1, 1, chunk.action_dim), np.float32)
    return zeros if chunk.normalizer is None else chunk.normalizer.unnormalize(zeros)


def measure_latencies(
    policy: Policy, clock: Clock, settings: ExecutorSettings, plans: Sequence[str]
) -> dict[str, Times]:
    """What the measured calls of each plan take on a neutral observation; with a prefix, if calls will have one.

    The plans take turns. The caller resets the policy before and after.
    """
    obs = neutral_observation(dict(policy.info.observation))
    known = {"prefix": neutral_action(policy.info.action)} if settings.seam == "prefix" else {}
    timer = Timer(len(plans), settings.warm_up, clock.now)
    for _ in range(settings.warm_up + settings.measured_calls):
        for i in timer.round():
            timer.time(i, partial(policy.predict_action, obs, plan=plans[i], **known))
    return dict(zip(plans, timer.times, strict=True))
