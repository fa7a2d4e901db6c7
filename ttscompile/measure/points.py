"""Points of action error and latency, and which of them no other beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeVar


@dataclass(frozen=True)
class Point:
    """One plan.

    Attributes:
        series: strategy, or artifact.
        name: of the plan in its series; a sparsity of a strategy.
        error: mean absolute difference of the executed actions from those of the dense policy, in their units.
        latency_ms: median wall time of a call on one stream.
    """

    series: str
    name: str
    error: float
    latency_ms: float


@dataclass(frozen=True)
class MeasuredPoint(Point):
    """One plan on the held-out calls of a comparison.

    Attributes:
        sparsity: share of the cells that are reused, mean over the calls.
        flops: of a call, mean.
        error_p90: 90th percentile over the calls.
        quartiles_ms: first and third quartile of the latency.
        noise: what its noise has in common with the dense calls': ``all`` or ``initial``.
    """

    sparsity: float
    flops: float
    error_p90: float
    quartiles_ms: tuple[float, float]
    noise: str


AnyPoint = TypeVar("AnyPoint", bound=Point)


def efficient(points: Sequence[AnyPoint]) -> tuple[AnyPoint, ...]:
    """Points that no other beats in error and latency both, fastest first."""
    best: list[AnyPoint] = []
    for point in sorted(points, key=lambda p: (p.latency_ms, p.error)):
        if not best or point.error < best[-1].error:
            best.append(point)
    return tuple(best)


@dataclass(frozen=True)
class Comparison:
    """The outcome of a comparison.

    Attributes:
        points: in the order of the series.
        calls: held-out calls that each point was measured on.
        episodes: numbers of the held-out episodes.
        threads: threads that onnxruntime computed with.
        yardsticks: mean error of a dense call with other noise: ``steps``: the same initial sample and other draws (of
            stochastic samplers alone); ``all``: everything else.
        skipped: why a strategy has no plan at a sparsity.
        warnings: what a reader has to know.
    """

    points: tuple[MeasuredPoint, ...]
    calls: int
    episodes: tuple[int, ...]
    threads: int
    yardsticks: Mapping[str, float]
    skipped: Mapping[str, str]
    warnings: tuple[str, ...]

    def efficient(self) -> tuple[MeasuredPoint, ...]:
        """Points that no other beats in error and latency both, fastest first."""
        return efficient(self.points)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        best = self.efficient()
        points = [{**asdict(p), "quartiles_ms": list(p.quartiles_ms), "efficient": p in best} for p in self.points]
        record = {**asdict(self), "points": points, "episodes": list(self.episodes), "warnings": list(self.warnings)}
        return {**record, "yardsticks": dict(self.yardsticks), "skipped": dict(self.skipped)}
