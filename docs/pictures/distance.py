"""Draws distance.png: what plans lost in episodes, against how far they are from the original.

python docs/pictures/distance.py [FILE]

The plans are those of ``docs/evidence/driven.json`` that were judged by ``calibration.judge`` and whose success in
episodes is known.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ttscompile.artifact.ceiling import BOUND, FARTHEST

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples" / "evaluation"))
from driven import MARGINS, Row, read

FEW = 400
"""Episodes, below which a point is hollow: hardly any such plan can be called equivalent."""
NEAR = 0.46
"""Distance beyond which plans lose so much that they have a panel of their own."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8c564b")


def plans() -> list[Row]:
    """Those with a distance and a difference of success."""
    return [row for row in read() if row.distance is not None and row.success is not None]


def panel(axes: Any, rows: list[Row], colours: dict[str, str]) -> None:
    """Draw some of them."""
    for row in rows:
        assert row.success is not None
        mean, low, high = row.success
        colour = colours[row.policy]
        inside = "white" if row.episodes < FEW else colour
        style: dict[str, Any] = {"color": colour, "markerfacecolor": inside, "capsize": 3, "elinewidth": 1}
        axes.errorbar(row.distance, mean, [[mean - low], [high - mean]], fmt="o", **style)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.axhline(-MARGINS["success"], color="grey", linewidth=0.8, linestyle=":")


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    near, far = figure.subplots(1, 2, width_ratios=(3, 1.3))
    rows = plans()
    colours = dict(zip(dict.fromkeys(row.policy for row in rows), COLOURS, strict=True))
    distances = [row.distance or 0.0 for row in rows]
    panel(near, [row for row in rows if (row.distance or 0.0) <= NEAR], colours)
    panel(far, [row for row in rows if (row.distance or 0.0) > NEAR], colours)
    for policy, colour in colours.items():
        near.plot([], [], "o", color=colour, label=policy)
    near.plot([], [], "o", color="grey", markerfacecolor="white", label=f"fewer than {FEW} episodes")
    for bound, name in ((BOUND, "the default"), (FARTHEST, "fast")):
        near.axvline(bound, color="grey", linewidth=0.8, linestyle="--")
        near.annotate(f" {name}", (bound, 0.02), xycoords=("data", "axes fraction"), color="grey")
    near.set_xlabel("distance from the original, in units of what other noise changes")
    near.set_ylabel("success, difference in points")
    near.set_xlim(min(0.0, *distances) - 0.01, NEAR + 0.01)
    near.set_title(f"up to {NEAR:g}", fontsize=9)
    far.set_title("further away", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncol=4, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("distance.png"))
