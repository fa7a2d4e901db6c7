"""Plans take turns, call by call, on the same observations and noise: their error and their latency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.load import Artifact
from ..artifact.manifest import DENSE
from ..core.lattice import Source
from ..core.spec import FP32, Noise
from ..measure.points import MeasuredPoint
from ..measure.timer import Timer, Times
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import random_noise
from ..trajectories.episodes import Episode
from .calls import LARGEST

WARM_UP = 2
"""Rounds whose times do not count, where there are more than these; their actions count."""

Array = npt.NDArray[Any]
Progress = Callable[[str, int, int], None]
"""Told what is being done, how many parts are done, and of how many."""


@dataclass(frozen=True)
class Entrant:
    """A plan that takes part.

    Attributes:
        series: see ``MeasuredPoint``.
        name: see ``MeasuredPoint``.
        policy: that runs it.
        plan: its name there.
        paired: whether it takes all the noise of the dense calls.
    """

    series: str
    name: str
    policy: CompiledPolicy
    plan: str
    paired: bool


def measure(
    artifact: Artifact,
    entrants: Sequence[Entrant],
    episodes: Sequence[Episode],
    chosen: Sequence[tuple[int, int]],
    seed: int,
    threads: int,
    progress: Progress,
) -> tuple[tuple[MeasuredPoint, ...], dict[str, float]]:
    """All entrants on all calls, in turn; and the yardsticks.

    Args:
        artifact: whose dense policy is the truth.
        entrants: at least one.
        episodes: all of them.
        chosen: number of the episode, and row in it, of each call.
        seed: of the noise.
        threads: of the dense policy.
        progress: told how far it is.

    Returns:
        A point for each entrant, and ``Frontier.yardsticks``.
    """
    # Noise of the original's shape fits every artifact of the policy, however many steps it predicts.
    spec, draw = artifact.manifest.spec.original, np.random.default_rng((seed, 4))
    exact = artifact.at_precision(FP32)
    truth = CompiledPolicy(exact, open_runtime(exact, "onnxruntime", threads))
    errors: list[list[float]] = [[] for _ in entrants]
    reports: list[list[tuple[float, float]]] = [[] for _ in entrants]
    apart: dict[str, list[float]] = {"all": [], **({"steps": []} if spec.sampler.stochastic else {})}
    timer = Timer(len(entrants), WARM_UP if len(chosen) > WARM_UP else 0)
    for number, (episode, row) in enumerate(chosen):
        obs = {key: array[row : row + 1] for key, array in episodes[episode].observations.items()}
        one, two = random_noise(spec, draw), random_noise(spec, draw)
        dense = _call(truth, obs, one, DENSE)
        apart["all"].append(_error(_call(truth, obs, two, DENSE), dense))
        if "steps" in apart:
            mixed = Noise(one.initial, two.steps)
            apart["steps"].append(_error(_call(truth, obs, mixed, DENSE), dense))
        for i in timer.round():
            policy = entrants[i].policy
            call = partial(
                _call, policy, obs, one if entrants[i].paired else _adapted(one, policy, draw), entrants[i].plan
            )
            errors[i].append(_error(timer.time(i, call), dense))
            report = policy.last_report
            assert report is not None
            reports[i].append((float(np.mean(report.plan != Source.COMPUTE)), report.flops[0]))
        progress("held-out calls", number + 1, len(chosen))
    points = tuple(map(_point, entrants, errors, timer.times, reports))
    return points, {name: float(np.mean(found)) for name, found in apart.items()}


def _point(entrant: Entrant, errors: list[float], times: Times, reports: list[tuple[float, float]]) -> MeasuredPoint:
    sparsity, flops = np.mean(reports, axis=0)
    return MeasuredPoint(
        series=entrant.series,
        name=entrant.name,
        sparsity=float(sparsity),
        flops=float(flops),
        error=float(np.mean(errors)),
        error_p90=float(np.quantile(errors, 0.9)),
        latency_ms=times.median,
        quartiles_ms=times.quartiles,
        noise="all" if entrant.paired else "initial",
    )


def _call(policy: CompiledPolicy, obs: Mapping[str, Array], noise: Noise, plan: str) -> Array:
    """The executed actions of a first call, ``[Ta, Da]``."""
    policy.reset()
    actions: Array = policy.predict_action(obs, noise=noise, plan=plan)["action"][0]
    return actions


def _error(actions: Array, dense: Array) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(actions - dense).mean()
    return float(np.nan_to_num(difference, nan=LARGEST, posinf=LARGEST))


def _adapted(noise: Noise, policy: CompiledPolicy, draw: np.random.Generator) -> Noise:
    """The same initial sample, with the draws that another sampler needs."""
    info = policy.info
    if not info.stochastic:
        return Noise(noise.initial)
    return Noise(noise.initial, draw.standard_normal((info.K, *noise.initial.shape), dtype=np.float32))
