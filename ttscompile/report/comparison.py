"""Points of distance from the original against latency, from what ``ttscompile bench -t --json`` printed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..core.paths import require_path
from ..core.untrusted_json import parse_json
from ..errors import ReportError
from ..measure.points import Point

MAX_BYTES = 16 * 2**20
_REMEDY = "Give what 'ttscompile bench DIRECTORY -t FILE... --json' printed."


def read_comparison(path: Path) -> tuple[Point, ...]:
    """Points of a comparison. Raises ReportError: the file is not what ``ttscompile bench -t --json`` prints."""
    require_path(path, ReportError, _REMEDY)
    try:
        with path.open("rb") as file:
            document: Any = parse_json(file.read(MAX_BYTES + 1), MAX_BYTES)
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: no JSON document: {error}. {_REMEDY}") from error
    document = document.get("comparison") if isinstance(document, dict) else None
    document = document if isinstance(document, dict) else {}
    points: Any = document.get("points")
    good = isinstance(points, list) and all(
        isinstance(p, dict) and all(map(_is_number, (p.get("distance"), p.get("latency_ms")))) for p in points
    )
    if not good:
        raise ReportError(
            f"{path}: expected a 'comparison' with 'points', which have distance and latency_ms; found"
            f" {sorted(map(str, document))[:8]}. {_REMEDY}"
        )
    return tuple(
        Point(str(p.get("series", "")), str(p.get("name", "")), max(float(p["distance"]), 0.0), float(p["latency_ms"]))
        for p in points
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
