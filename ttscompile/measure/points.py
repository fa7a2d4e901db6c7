"""Points of distance and latency, and which of them no other beats.

The distance between what a plan and the original answer is the energy distance (Szekely and Rizzo, 2013):
``calibration.judge``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from .timer import Times

Numbers = npt.NDArray[np.float64]

SAME, TENTH = 1e-4, 0.1
"""Of what another observation changes, or of a distance: less is rounding; and the unit where noise changes no more."""

LARGEST = 1e30
"""Error of actions that are not numbers, or off by more: finite, so that means and comparisons of plans mean something,
and a record can hold them."""

RESAMPLED = 1000
"""Samples of the bootstrap."""

STUDENT = (12.71, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""How many standard errors 95 % limits are away, for 1, 2, 3... degrees of freedom; ``_wider`` has those after them."""


def pairs(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """h, and how far two answers of the original are apart, mean over the pairs of draws of each call.

    Where noise changes nothing: the square of how far the plan is off, and that of a ``TENTH`` of how far answers to
    two observations are apart (of 1, where they are not), of which ``rooted`` makes a root mean square in this unit.

    Args:
        x: what a plan answers, ``[N, R, A]``.
        y: what the original answers.

    Returns:
        ``[N]`` twice.
    """
    found = []
    for i, j in combinations(range(x.shape[1]), 2):
        crossed = _far(x[:, i], y[:, j]) + _far(x[:, j], y[:, i])
        apart = _far(y[:, i], y[:, j])
        found.append((crossed - _far(x[:, i], x[:, j]) - apart, apart))
    h, far = np.mean(found, axis=0)
    others = [_far(y[:, 0], np.roll(y[:, 0], n, 0)).mean() for n in range(1, min(len(y), 33))]
    observed = np.mean(others or [0.0]) or 1.0
    if far.mean() > SAME * observed:
        return h, far
    return np.square(_far(x, y)).mean(1), np.full(len(x), (TENTH * observed) ** 2)


def _far(one: Numbers, other: Numbers) -> Numbers:
    return np.asarray(np.sqrt(np.square(one - other).mean(-1)))


def rooted(gap: float, apart: float) -> float:
    """The root of a mean h in units of how far answers of the original are apart; see ``signed_root``."""
    return float(signed_root(np.array(gap / max(apart, 1e-12))))


def signed_root(shares: Numbers) -> Numbers:
    """The roots of numbers; of one below 0 the negative root of its size, so that nothing is cut off."""
    return np.asarray(np.sign(shares) * np.sqrt(np.abs(shares)))


@dataclass(frozen=True, eq=False)
class Gaps:
    """How far a plan is off, call by call.

    Attributes:
        h: ``[N]``, over the mean of |y_i - y_j|.
        episodes: ``[N]``, of which each call is.
    """

    h: Numbers
    episodes: npt.NDArray[np.int64]

    @classmethod
    def of(cls, x: Numbers, y: Numbers, episodes: npt.NDArray[np.int64]) -> "Gaps":
        """Of what a plan and the original answer; see ``pairs``."""
        h, apart = pairs(x, y)
        return cls(h / max(float(apart.mean()), 1e-12), episodes)

    @cached_property
    def by_episode(self) -> list[Numbers]:
        """Of each episode the h of its calls."""
        return [self.h[self.episodes == one] for one in np.unique(self.episodes)]

    @property
    def mean(self) -> float:
        """Over episodes, each of which counts alike."""
        return float(np.mean([one.mean() for one in self.by_episode]))

    @property
    def distance(self) -> float:
        """In units of what other noise changes."""
        return rooted(self.mean, 1.0)

    @property
    def interval(self) -> tuple[float, float]:
        """Of the distance, with 95 % limits, for other calls and episodes."""
        low, high = np.quantile(signed_root(self.resampled(self.clustered)), (0.025, 0.975))
        return float(low), float(high)

    @property
    def clustered(self) -> bool:
        """Whether episodes differ by more than the differences of their calls explain, as an analysis of variance asks.

        Then the calls of an episode tell no more than one of them. Else they are as good as episodes, and there are
        more of them: a bootstrap of four episodes covers the distance in 81 of 100 trials where it says 95.
        """
        groups, spare = self.by_episode, len(self.h) - len(self.by_episode)
        if len(groups) < 2 or not spare:
            return False
        between = sum(len(one) * (one.mean() - self.h.mean()) ** 2 for one in groups) / (len(groups) - 1)
        return bool(between > sum(((one - one.mean()) ** 2).sum() for one in groups) / spare)

    def resampled(self, clustered: bool) -> Numbers:
        """Means of h with calls drawn anew, or whole episodes; the same draws for equally many.

        They are spread around the mean as Student's limits are, so that few calls tell little, and one nothing.
        """
        groups = self.by_episode
        if clustered:
            units = np.array([one.mean() for one in groups])
        else:  # so that their mean is that of episodes
            units = np.concatenate([one * len(self.h) / len(groups) / len(one) for one in groups])
        drawn = np.random.default_rng(0).integers(0, len(units), (RESAMPLED, len(units)))
        if len(units) == 1:
            return np.where(np.arange(RESAMPLED) % 2, -LARGEST, LARGEST)
        return np.asarray(self.mean + _wider(len(units)) * (units[drawn].mean(1) - self.mean))


def _wider(count: int) -> float:
    """By how much Student's limits are wider than a bootstrap's."""
    spare = count - 1
    limit = STUDENT[spare - 1] if spare <= len(STUDENT) else 1.96 + 2.4 / spare + 3 / spare**2
    return float(limit / 1.96 * np.sqrt(count / spare))


@dataclass(frozen=True)
class Point:
    """One plan.

    Attributes:
        series: proposer, or artifact.
        name: of the plan in its series; a sparsity of a proposer.
        distance: of its actions from the original's (``calibration.judge``).
        latency_ms: median wall time of a call on one stream.
    """

    series: str
    name: str
    distance: float
    latency_ms: float


@dataclass(frozen=True, eq=False)
class FarCall:
    """A held-out call, and what was answered to it, in the units of the actions.

    Attributes:
        name: of its episode.
        call: number of the call in its episode.
        distance: of this call alone.
        pictures: the newest frame of each camera, by key ``[C, H, W]``.
        actions: executed by the original and by the plan, with each draw of noise, ``[2, R, Ta, Da]``.
        numbers: of the action, those first in which the plan is further off with the first draw, once normalised.
    """

    episode: int
    name: str
    call: int
    distance: float
    pictures: Mapping[str, npt.NDArray[np.float32]]
    actions: npt.NDArray[np.float32]
    numbers: tuple[int, ...]

    @property
    def told(self) -> str:
        """Which call it is, and how far it is off."""
        return f"episode {self.episode}, call {self.call}: {self.distance:.2f}"


@dataclass(frozen=True, eq=False)
class JudgedPlan:
    """What the judge finds of one plan on held-out calls.

    Attributes:
        shown: the calls with the largest distance, the largest first, and last the one in the middle.
        warnings: what makes it say little.
    """

    name: str
    gaps: Gaps
    shown: tuple[FarCall, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class MeasuredPoint(Point):
    """One plan on the held-out calls of a comparison.

    Attributes:
        interval: 95 % interval of the distance.
        error: mean absolute difference of the executed actions from the original's with the same noise, in their units;
            None of another sampler or start, which takes other noise.
        error_p90: 90th percentile of that over the calls.
        quartiles_ms: first and third quartile of the latency.
        sparsity: share of the cells that are reused, mean over the calls.
        by_number: the distance of each number of the action alone.
        errors: the error of each number of the action, in its units; empty where there is none.
        outside: how far the observations are from what was recorded (``core.envelope``), of half of the calls, of nine
            tenths and of all at most; empty of a plan without a correction.
        furthest: the calls with the largest distance, the largest first.
    """

    interval: tuple[float, float]
    error: float | None
    error_p90: float | None
    quartiles_ms: tuple[float, float]
    sparsity: float
    flops: float
    by_number: tuple[float, ...] = ()
    errors: tuple[float, ...] = ()
    outside: tuple[float, ...] = ()
    furthest: tuple[FarCall, ...] = field(default=(), compare=False)


AnyPoint = TypeVar("AnyPoint", bound=Point)


def efficient(points: Sequence[AnyPoint]) -> tuple[AnyPoint, ...]:
    """Points that no other beats in distance and latency both, fastest first; no distance counts as below 0."""
    best: list[AnyPoint] = []
    for point in sorted(points, key=lambda p: (p.latency_ms, max(p.distance, 0.0))):
        if not best or max(point.distance, 0.0) < best[-1].distance:
            best.append(point)
    return tuple(best)


ALIKE = 1.2
"""Plans that take at most so many times as long as the fastest count as equally fast; those of them that are at most so
many times as far away as the nearest, as equally near. Where little is left to compute, a further step costs little and
makes a plan much nearer: the fourth of the demo's ten steps takes 9 to 14 % longer and is 2.3 times as near
(``docs/evidence/results.md``, what the demo shows)."""


def fastest(times_ms: Mapping[str, float], distances: Mapping[str, float]) -> str:
    """The name of the fastest plan; of those that are as fast the nearest, and of those that are as near the fastest.

    ``ALIKE`` says what counts as that, and so do three decimals of a distance. None counts as below 0.
    """
    alike = [name for name, taken in times_ms.items() if taken <= ALIKE * min(times_ms.values())]
    far = {name: round(max(distances[name], 0.0), 3) for name in alike}
    near = [name for name in alike if far[name] <= ALIKE * min(far.values())]
    return min(near, key=lambda name: (times_ms[name], far[name]))


def best_plan(times: Mapping[str, Times], distances: Mapping[str, float], deadline_ms: float | None) -> str | None:
    """The name of the plan, of those that may be the default, that is it.

    Without a deadline, in milliseconds, it is the ``fastest``. With one it is the nearest of those whose worst call
    keeps it; None if none does. The faster of two is the nearest where three decimals do not tell their distances
    apart.
    """
    if deadline_ms is None:
        return fastest({name: one.median for name, one in times.items()}, distances) if times else None
    in_time = [name for name, one in times.items() if one.worst <= deadline_ms]
    return min(in_time, key=lambda name: (round(distances[name], 3), times[name].median), default=None)


@dataclass(frozen=True)
class Comparison:
    """The outcome of a comparison.

    Attributes:
        calls: held-out calls that each point was measured on.
        threads: threads that onnxruntime computed with.
        other_noise: mean absolute difference of two dense calls of one observation, in the units of the actions.
        skipped: why a proposer has no plan at a sparsity.
    """

    points: tuple[MeasuredPoint, ...]
    calls: int
    episodes: tuple[int, ...]
    threads: int
    other_noise: float
    skipped: Mapping[str, str]
    warnings: tuple[str, ...]

    def efficient(self) -> tuple[MeasuredPoint, ...]:
        """Those of its points that no other beats; see the function."""
        return efficient(self.points)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        best = self.efficient()
        points = [
            {
                **vars(p),
                "furthest": [{"episode": c.episode, "call": c.call, "distance": c.distance} for c in p.furthest],
                "efficient": p in best,
            }
            for p in self.points
        ]
        return {**vars(self), "points": points, "skipped": dict(self.skipped)}
