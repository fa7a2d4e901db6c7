"""Draws distance.png: what plans lost in episodes, against how far they are from the original.

python docs/pictures/distance.py [FILE]

The plans are those of ``docs/evidence/driven.json``: those that were judged by
``calibration.judge`` and whose success in episodes is known.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ttscompile.artifact.ceiling import BOUND, FARTHEST

DRIVEN = Path(__file__).resolve().parents[1] / "evidence" / "driven.json"
MARGIN = 5.0
"""Points of success, below which a plan is called equivalent (``examples/evaluation/equivalence.py``)."""
FEW = 400
"""Episodes, below which a point is hollow: hardly any such plan can be called equivalent."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8c564b")


def plans() -> list[dict[str, Any]]:
    """A plan a row: policy, plan, distance, difference of success in points with its interval, and episodes."""
    found: list[dict[str, Any]] = json.loads(DRIVEN.read_text())["plans"]
    return found


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    rows = plans()
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    for policy, colour in zip(policies, COLOURS, strict=True):
        for row in (row for row in rows if row["policy"] == policy):
            ends = [[row["points"] - row["low"]], [row["high"] - row["points"]]]
            inside = "white" if row["episodes"] < FEW else colour
            axes.errorbar(
                row["distance"],
                row["points"],
                ends,
                fmt="o",
                color=colour,
                markerfacecolor=inside,
                capsize=3,
                elinewidth=1,
            )
        axes.plot([], [], "o", color=colour, label=policy)
    axes.plot([], [], "o", color="grey", markerfacecolor="white", label=f"fewer than {FEW} episodes")
    axes.axhline(0, color="black", linewidth=0.8)
    axes.axhline(-MARGIN, color="grey", linewidth=0.8, linestyle=":")
    for bound, name in ((BOUND, "the default"), (FARTHEST, "fast")):
        axes.axvline(bound, color="grey", linewidth=0.8, linestyle="--")
        axes.annotate(f" {name}", (bound, 0.98), xycoords=("data", "axes fraction"), va="top", color="grey")
    axes.set_xlabel("distance from the original, in units of what other noise changes")
    axes.set_ylabel("success, difference in points")
    axes.set_xlim(min(0.0, *(row["distance"] - 0.01 for row in rows)), None)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncol=4, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("distance.png"))
