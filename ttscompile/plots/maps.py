"""Pictures of plans: steps across, blocks down, colour by source."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.lattice import PlanArray, Source, sparsity
from ..errors import IllegalPlanError
from .figure import STEPS_AXIS, block_names, new_figure, write_picture

COLOURS = {
    Source.COMPUTE: "#d55e00",
    Source.FORWARD: "#009e73",
    Source.TIMESTEP: "#b9dcf2",
    Source.ROLLOUT: "#f0e442",
}
"""From Okabe and Ito's palette, which colour-blind readers can tell apart; what is computed is the darkest."""


def plot_plan(plan: PlanArray, kinds: Sequence[str], path: str | Path, title: str = "") -> None:
    """Draw one plan and write the picture.

    Args:
        plan: int8 ``[K, blocks]`` of ``Source``.
        kinds: kind of each block, in order of execution.
        path: see ``write_picture``.
        title: over the picture; the sparsity is added to it.

    Raises:
        IllegalPlanError: the plan is not a matrix of sources, or does not have a column for each kind.
        RuntimeUnavailableError: matplotlib is not installed.
        OutputError: the picture cannot be written.
    """
    if plan.ndim != 2 or plan.shape[1] != len(kinds) or not np.isin(plan, list(Source)).all():
        raise IllegalPlanError(
            f"cannot draw a plan of shape {plan.shape} with values {np.unique(plan).tolist()}; expected"
            f" [K, {len(kinds)}] of ttscompile.Source, 0..3."
        )
    steps, blocks = plan.shape
    size = min(6.0 + 0.03 * steps, 12.0), min(1.9 + 0.17 * blocks, 14.0)
    figure = new_figure(*size, "a picture of a plan", "the plan")
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    axes = figure.add_subplot()
    axes.imshow(
        plan.T, cmap=ListedColormap([COLOURS[s] for s in Source]), vmin=0, vmax=3, aspect="auto", interpolation="none"
    )
    axes.set_xticks(np.arange(-0.5, steps), minor=True)
    axes.set_yticks(np.arange(-0.5, blocks), minor=True)
    axes.grid(which="minor", color="white", linewidth=0.4)
    axes.tick_params(which="minor", length=0)
    axes.set_yticks(range(blocks), block_names(kinds), fontsize=7)
    axes.set_xlabel(STEPS_AXIS)
    axes.set_ylabel("residual block")
    heading = f"{sparsity(plan):.1%} of {plan.size} cells reused"
    axes.set_title(f"{title}: {heading}" if title else heading, fontsize=10, loc="left")
    counts = {s: int(np.count_nonzero(plan == s)) for s in Source}
    figure.legend(
        handles=[
            Patch(facecolor=COLOURS[s], edgecolor="#444444", linewidth=0.5, label=f"{s.name.lower()} {counts[s]}")
            for s in Source
        ],
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
    write_picture(figure, path)
