"""Points of action error against latency, from the calibration record or from ``ttscompile compare --json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ReportError
from ..measure.points import Point
from .facts import scores
from .measure import Latency

_NUMBERS = ("error", "latency_ms")


Compared = tuple[tuple[Point, ...], dict[str, float]]
"""Points and yardsticks of a comparison."""


def from_record(record: Mapping[str, Any] | None, latencies: Sequence[Latency]) -> tuple[Point, ...]:
    """The plans of an artifact that calibration judged and that were timed."""
    judged = scores(record)
    return tuple(
        Point("this artifact", one.plan, float(judged[one.plan]["error"]), one.total)
        for one in latencies
        if one.plan in judged
    )


def from_comparison(document: Mapping[str, Any]) -> Compared:
    """Points and yardsticks of a comparison.

    Raises:
        ReportError: it is not what ``ttscompile compare --json`` prints.
    """
    found, yardsticks = document.get("points"), document.get("yardsticks", {})
    good = isinstance(found, list) and isinstance(yardsticks, dict)
    good = good and all(isinstance(p, dict) and all(_is_number(p.get(name)) for name in _NUMBERS) for p in found or ())
    if not good or not all(_is_number(value) for value in yardsticks.values()):
        raise ReportError(
            "the comparison is not what 'ttscompile compare ... --json' prints: expected 'points' with error and"
            f" latency_ms, and 'yardsticks'; found {sorted(map(str, document))[:8]}. Give that command's output."
        )
    points = tuple(
        Point(str(p.get("series", "")), str(p.get("name", "")), float(p["error"]), float(p["latency_ms"]))
        for p in found or ()
    )
    return points, {name: float(value) for name, value in yardsticks.items() if name in ("steps", "all")}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
