"""Draws lattice.png: the cells of two consecutive calls, and where a residual may be taken from.

python docs/pictures/lattice.py [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

from ttscompile.core.lattice import Source
from ttscompile.plots.maps import COLOURS

STEPS, KINDS = 6, ("SA", "FF", "SA", "FF", "SA", "FF")
TOLD = {
    Source.COMPUTE: "COMPUTE: evaluate the block",
    Source.FORWARD: "FORWARD: last computed block of this kind",
    Source.TIMESTEP: "TIMESTEP: this block, last computed step",
    Source.ROLLOUT: "ROLLOUT: this cell, the call before",
}
NOW = {(2, 4): Source.FORWARD, (4, 1): Source.TIMESTEP, (3, 3): Source.ROLLOUT}
"""Cells (step, block) of the second call that are not COMPUTE, of those that have colours."""

ARROWS = (((1, 2, 2), (1, 2, 4)), ((1, 3, 1), (1, 4, 1)), ((0, 3, 3), (1, 3, 3)))
"""(call, step, block) read from, and read by."""

GAP = STEPS + 2.2


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch, Patch, Rectangle

    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for call in (0, 1):
        for step in range(STEPS):
            for block in range(len(KINDS)):
                source = NOW.get((step, block)) if call else None
                dark = source is not None or (call, step, block) in [start for start, _ in ARROWS]
                colour = COLOURS[source] if source is not None else COLOURS[Source.COMPUTE] if dark else "#f4f4f4"
                corner = (call * GAP + step + 0.06, block + 0.06)
                axes.add_patch(Rectangle(corner, 0.88, 0.88, facecolor=colour, edgecolor="#888888", linewidth=0.6))
        name = "call r" if call else "call r - 1"
        axes.text(call * GAP + STEPS / 2, -0.45, name, ha="center", fontsize=12)
        axes.text(call * GAP + STEPS / 2, len(KINDS) + 0.6, "denoising steps k →", ha="center", fontsize=9)
    for block, kind in enumerate(KINDS):
        axes.text(-0.2, block + 0.5, f"{kind} {block}", ha="right", va="center", fontsize=9)
    for (c0, k0, b0), (c1, k1, b1) in ARROWS:
        start, end = (c0 * GAP + k0 + 0.5, b0 + 0.5), (c1 * GAP + k1 + 0.5, b1 + 0.5)
        bend = "arc3,rad=-0.25" if c0 != c1 else "arc3,rad=0"
        axes.add_patch(
            FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=16, linewidth=1.8, connectionstyle=bend)
        )
    handles = [Patch(facecolor=COLOURS[s], edgecolor="#444444", linewidth=0.5, label=TOLD[s]) for s in Source]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=10)
    axes.set_xlim(-1.2, GAP + STEPS + 0.2)
    axes.set_ylim(len(KINDS) + 0.9, -1)
    axes.set_aspect("equal")
    axes.axis("off")
    figure.savefig(path, dpi=130, metadata={"Software": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("lattice.png"))
