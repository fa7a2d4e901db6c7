"""What is measured for a report: calls of every plan in turn, and one episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lattice import PlanArray, Source
from ..core.spec import Noise, PolicySpec
from ..measure.timer import Timer, Times
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import random_call
from ..runtimes.report import CallReport
from ..trajectories.episodes import Episode

PARTS = ("prologue", "wait_pruner", "decode")
"""Timings of a call that add up to nearly its total; the pruner runs beside step 0, only the wait for it counts."""

WARM_UP = 2
EPISODE_CALLS = 64
"""Of an episode at most: a picture of more says no more."""


@dataclass(frozen=True)
class Latency:
    """Medians over the counted calls of one plan, in ms.

    Attributes:
        plan: its name.
        total: from the normalised observation to the denoised sample.
        quartiles: first and third of the total.
        parts: of ``PARTS`` by name; and ``pruner``, the pruner's own time, most of it beside step 0.
        flops: FLOPs of a call.
    """

    plan: str
    total: float
    quartiles: tuple[float, float]
    parts: Mapping[str, float]
    flops: float


@dataclass(frozen=True)
class Course:
    """One episode with one plan.

    Attributes:
        name: file and number of the episode.
        plans: int8 ``[R, K, blocks]``, as executed.
        legalised: cells of each call that were replaced because they were never computed.
    """

    name: str
    plans: PlanArray
    legalised: tuple[int, ...]

    @property
    def sparsity(self) -> npt.NDArray[np.float64]:
        """Share of reused cells of each call, ``[R]``."""
        return np.asarray(np.mean(self.plans != Source.COMPUTE, axis=(1, 2)), dtype=np.float64)

    def shares(self) -> npt.NDArray[np.float64]:
        """For each source and cell the share of calls in which the cell had it, ``[4, K, blocks]``."""
        return np.stack([np.mean(self.plans == source, axis=0) for source in Source])


def measure_parts(policy: CompiledPolicy, spec: PolicySpec, plans: Sequence[str], runs: int) -> list[Latency]:
    """What calls spend their time on, by their own reports; plans take turns.

    Args:
        policy: loaded; it is reset before and after.
        spec: its specification.
        plans: their names.
        runs: counted calls of each.
    """
    obs, noise = random_call(spec, 0, 0)
    reports: list[list[CallReport]] = [[] for _ in plans]
    policy.reset()
    timer = Timer(len(plans), WARM_UP)
    for _ in range(WARM_UP + runs):
        for i in timer.round():
            policy.forget_frames()  # a call may have to compute them all
            report = _call(policy, obs, plans[i], noise)
            if timer.counted:
                reports[i].append(report)
    policy.reset()
    found = []
    for plan, made in zip(plans, reports, strict=True):
        total = Times(tuple(report.timings.total for report in made))
        parts = {
            p: float(np.median([getattr(report.timings, p) for report in made])) for p in (*PARTS, "pruner", "frames")
        }
        count = float(np.median([report.flops[0] for report in made]))
        found.append(Latency(plan, total.median, total.quartiles, parts, count))
    return found


def run_episode(policy: CompiledPolicy, episode: Episode, plan: str | None = None) -> Course:
    """A plan on consecutive calls, from a reset.

    Args:
        policy: loaded with a seed; it is reset before and after.
        episode: its first ``EPISODE_CALLS`` calls are run.
        plan: its name; None for the policy's default.
    """
    policy.reset()
    made = []
    for row in range(min(episode.calls, EPISODE_CALLS)):
        obs = {key: array[row : row + 1] for key, array in episode.observations.items()}
        made.append(_call(policy, obs, plan))
    policy.reset()
    plans = np.stack([report.plan[0] for report in made])
    return Course(episode.name, plans, tuple(report.legalised[0] for report in made))


def _call(policy: CompiledPolicy, obs: Mapping[str, Any], plan: str | None, noise: Noise | None = None) -> CallReport:
    policy.predict_action(obs, noise=noise, plan=plan)
    report = policy.last_report
    assert report is not None  # a call was made
    return report
