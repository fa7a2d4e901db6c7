"""Time as the executor sees it; and what calls take, measured by it."""

import inspect
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ExecutorError
from ttscompile.measure.timer import Timer, Times

from .settings import NO_CHUNK, Policy, Resolved


class Clock(Protocol):
    """A clock that never goes back, and the only way in which the executor waits.

    Both methods are called with the executor's lock held: they must not call the executor.
    """

    def now(self) -> float:
        """Seconds since some fixed moment."""

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """Wait until the condition is notified or ``timeout`` seconds of this clock have passed.

        May return early; callers look again at what they wait for.
        """


class MonotonicClock:
    """``time.monotonic``: the same in every process of the machine, so frames can be stamped elsewhere."""

    def now(self) -> float:
        """Seconds since some fixed moment."""
        return time.monotonic()

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """See ``Clock.wait``."""
        condition.wait(None if timeout is None else min(timeout, threading.TIMEOUT_MAX))


def require_plans(policy: Policy, settings: Resolved) -> None:
    """Raise ExecutorError unless every plan that calls may run goes with the seam and the horizon; warn of losses."""
    info, plans = policy.info, getattr(policy, "plans", None)
    executed = info.action.executes
    for name in settings.plans:
        if settings.seam == "prefix":
            _require_prefix(policy, settings, name)
        own = plans.get(name.partition("@")[0]) if isinstance(plans, Mapping) else None
        correction = getattr(own, "correction", None) if settings.seam == "prefix" else None
        if correction is not None and (most := correction.of(1).prefixes) < settings.horizon:
            told = f"plan {name!r} has a correction that was fitted to calls with at most {most} committed actions"
            remedy = "Calibrate the artifact again, take a plan without a correction, or seam='replace'"
            more = f"of this executor have up to {settings.horizon}, and may be further from the original's"
            warnings.warn(f"{told}; those {more}. {remedy}.", stacklevel=3)
        follows = own is None and name == info.default_plan and getattr(info, "follows", False)
        if settings.horizon > executed and (follows or getattr(own, "otherwise", None) is not None):
            told = f"begins with the chunk of the call before, but not after more than the policy's {executed} actions"
            remedy = f"Give at most {executed}, or other tiers"
            raise ExecutorError(f"horizon = {settings.horizon}: plan {name!r} {told}. {remedy}.")


def _require_prefix(policy: Policy, settings: Resolved, plan: str) -> None:
    """Raise unless ``predict_action`` has a parameter of the name ``prefix``, and the policy has nothing against it."""
    takes = "prefix" in inspect.signature(policy.predict_action).parameters
    refusal_of = getattr(policy, "prefix_refusal", lambda plan=None: getattr(policy.info, "prefix_refusal", None))
    refusal = refusal_of(**settings.plan_argument(plan)) if takes else None
    if not takes or refusal is not None:
        why = f"plan {plan!r} of this one does not: {refusal}" if takes else f"{type(policy).__name__} does not."
        needed = "seam='prefix' needs a policy whose predict_action takes prefix= and inpaints it"
        raise ExecutorError(f"{needed}; {why} Use seam='blend' or seam='replace', or other plans.")


def some_observation(specs: Mapping[str, ObservationSpec]) -> dict[str, Array]:
    """An observation of one stream to measure with: random, and always the same. Zeros may be none: a mask, a token."""
    rng = np.random.default_rng(0)
    return {key: spec.draw(rng) for key, spec in specs.items()}


def measure_latencies(policy: Policy, clock: Clock, settings: Resolved) -> dict[str, Times]:
    """What the measured calls of each plan take on ``some_observation``; with a prefix, if calls will have one.

    The plans take turns. Every third call has no chunk to begin with, as one after a late call, and may take longer for
    that. The caller resets the policy before and after.
    """
    plans = settings.plans
    obs, known = some_observation(policy.info.observation), dict[str, Any]()
    if settings.seam == "prefix":  # one action that the normaliser maps to 0, with poses as they are measured
        chunk = policy.info.action
        reference = chunk.reference(obs)
        known["prefix"] = chunk.unnormalized(np.zeros((1, 1, chunk.action_dim), np.float32), reference, chunk.start)
        for pose in () if chunk.relative is None else chunk.relative.poses:
            known["prefix"][..., pose.numbers] = reference[..., pose.numbers]
    forget: Callable[[], object] = getattr(policy, "forget_frames", lambda: None)  # a call may have to compute them all
    follow: Callable[[int], object] = getattr(policy, "follow", lambda _: None)
    timer = Timer(len(plans), settings.warm_up, clock.now)
    for number in range(-settings.warm_up, settings.measured_calls):
        for i in timer.round():
            forget()
            if number % 3 == 0:
                follow(NO_CHUNK)
            timer.time(i, partial(policy.predict_action, obs, **settings.plan_argument(plans[i]), **known))
    return dict(zip(plans, timer.times, strict=True))
