"""The outcome of a comparison: points of action error and latency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Point:
    """One plan on the held-out calls.

    Attributes:
        series: strategy, or artifact.
        name: of the plan in its series; a sparsity of a strategy.
        sparsity: share of the cells that are reused, mean over the calls.
        flops: of a call, mean.
        error: mean absolute difference of the executed actions from those of the dense policy, in their units.
        error_p90: 90th percentile over the calls.
        latency_ms: median wall time of a call on one stream.
        quartiles_ms: first and third quartile.
        noise: what its noise has in common with the dense calls': ``all`` or ``initial``.
    """

    series: str
    name: str
    sparsity: float
    flops: float
    error: float
    error_p90: float
    latency_ms: float
    quartiles_ms: tuple[float, float]
    noise: str


@dataclass(frozen=True)
class Frontier:
    """The outcome of a comparison.

    Attributes:
        points: in the order of the series.
        calls: held-out calls that each point was measured on.
        episodes: numbers of the held-out episodes.
        threads: of onnxruntime.
        yardsticks: mean error of a dense call with other noise: ``steps``: the same initial sample and other draws (of
            stochastic samplers alone); ``all``: everything else.
        skipped: why a strategy has no plan at a sparsity.
        warnings: what a reader has to know.
    """

    points: tuple[Point, ...]
    calls: int
    episodes: tuple[int, ...]
    threads: int
    yardsticks: Mapping[str, float]
    skipped: Mapping[str, str]
    warnings: tuple[str, ...]

    def efficient(self) -> tuple[Point, ...]:
        """Points that no other beats in error and latency both, fastest first."""
        best: list[Point] = []
        for point in sorted(self.points, key=lambda p: (p.latency_ms, p.error)):
            if not best or point.error < best[-1].error:
                best.append(point)
        return tuple(best)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        efficient = self.efficient()
        points = [{**asdict(p), "quartiles_ms": list(p.quartiles_ms), "efficient": p in efficient} for p in self.points]
        record = {**asdict(self), "points": points, "episodes": list(self.episodes), "warnings": list(self.warnings)}
        return {**record, "yardsticks": dict(self.yardsticks), "skipped": dict(self.skipped)}
