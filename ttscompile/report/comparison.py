"""Points of action error against latency, from what ``ttscompile bench -t --json`` printed."""

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

Compared = tuple[tuple[Point, ...], dict[str, float]]
"""Points and yardsticks of a comparison."""


def read_comparison(path: Path) -> Compared:
    """Points and yardsticks of a comparison.

    Raises:
        ReportError: the file is not what ``ttscompile bench -t --json`` prints.
    """
    require_path(path, ReportError, _REMEDY)
    try:
        with path.open("rb") as file:
            document: Any = parse_json(file.read(MAX_BYTES + 1), MAX_BYTES)
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: no JSON document: {error}. {_REMEDY}") from error
    document = document.get("comparison") if isinstance(document, dict) else None
    document = document if isinstance(document, dict) else {}
    points: Any = document.get("points")
    yardsticks = document.get("yardsticks", {})
    good = isinstance(points, list) and isinstance(yardsticks, dict)
    good = good and all(isinstance(p, dict) and _is_number(p.get("error")) for p in points)
    good = good and all(map(_is_number, [*(p.get("latency_ms") for p in points), *yardsticks.values()]))
    if not good:
        raise ReportError(
            f"{path}: expected a 'comparison' with 'points', which have error and latency_ms, and with 'yardsticks';"
            f" found {sorted(map(str, document))[:8]}. {_REMEDY}"
        )
    found = (
        Point(str(p.get("series", "")), str(p.get("name", "")), float(p["error"]), float(p["latency_ms"]))
        for p in points
    )
    return tuple(found), {name: float(value) for name, value in yardsticks.items() if name in ("steps", "all")}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
