"""Pictures with steps across and blocks down: a plan, coloured by source; and where an artifact is not the original."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..core.lattice import PlanArray, Source, sparsity
from ..errors import IllegalPlanError
from .figure import STEPS_AXIS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {Source.COMPUTE: "#d55e00", Source.FORWARD: "#009e73", Source.TIMESTEP: "#b9dcf2", Source.ROLLOUT: "#f0e442"}
"""From Okabe and Ito's palette, which colour-blind readers can tell apart; what is computed is the darkest."""

_LEAST, _MOST = -8.0, 0.0  # powers of ten at the ends of the colours: rounding, and another residual altogether

_ABBREVIATIONS = {"self_attention": "SA", "cross_attention": "CA", "feed_forward": "FF"}


def plot_plan(plan: PlanArray, kinds: Sequence[str], title: str = "") -> Figure:
    """One plan, int8 ``[K, blocks]``, with the kind of each block, under a title to which the sparsity is added.

    Raises IllegalPlanError: the plan is not a matrix of sources, or does not have a column for each kind.
    """
    if plan.ndim != 2 or plan.shape[1] != len(kinds) or not np.isin(plan, list(Source)).all():
        raise IllegalPlanError(
            f"cannot draw a plan of shape {plan.shape} with values {np.unique(plan).tolist()}; expected"
            f" [K, {len(kinds)}] of ttscompile.Source, 0..3."
        )
    steps, blocks = plan.shape
    figure, axes = _map(6.0 + 0.03 * steps, 1.9 + 0.17 * blocks, kinds, "the plan")
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ListedColormap([COLOURS[s] for s in Source])
    axes.imshow(plan.T, cmap=colours, vmin=0, vmax=3, aspect="auto", interpolation="none")
    axes.set_xticks(np.arange(-0.5, steps), minor=True)
    axes.set_yticks(np.arange(-0.5, blocks), minor=True)
    axes.grid(which="minor", color="white", linewidth=0.4)
    axes.tick_params(which="minor", length=0)
    heading = f"{sparsity(plan):.1%} of {plan.size} cells reused"
    axes.set_title(f"{title}: {heading}" if title else heading, fontsize=10, loc="left")
    names = {s: f"{s.name.lower()} {np.count_nonzero(plan == s)}" for s in Source}
    patches = [Patch(facecolor=COLOURS[s], edgecolor="#444444", linewidth=0.5, label=names[s]) for s in Source]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def plot_errors(
    errors: npt.NDArray[np.float64],
    steps: Sequence[int],
    kinds: Sequence[str],
    tolerance: float,
    title: str = "",
    cells: npt.NDArray[np.bool_] | None = None,
) -> Figure:
    """Relative errors of residuals ``[A, blocks]`` at these A steps; those above the tolerance are framed.

    ``cells``, bool ``[K, blocks]``, are those of a plan that are marked; None for none.
    """
    count, blocks = errors.shape
    figure, axes = _map(6.5 + 0.03 * count, 2.2 + 0.17 * blocks, kinds, "the errors")
    shown = np.log10(np.clip(np.nan_to_num(errors, nan=1.0, posinf=1.0), 10**_LEAST, 10**_MOST)).T
    image = axes.imshow(shown, cmap="viridis", vmin=_LEAST, vmax=_MOST, aspect="auto", interpolation="none")
    above = np.argwhere(~(errors <= tolerance))
    marked = np.zeros((0, 2), int) if cells is None else np.argwhere(cells[list(steps)])
    if len(above):
        axes.scatter(above[:, 0], above[:, 1], s=9, marker="s", facecolors="none", edgecolors="#d55e00", linewidths=0.9)
    if len(marked):
        axes.scatter(marked[:, 0], marked[:, 1], s=12, marker="x", color="#f0e442", linewidths=0.9)
    told = f"{len(above)} of {errors.size} residuals differ by more than {tolerance:g} (framed)"
    axes.set_title(f"{title}\n{told}" if title else told, fontsize=9, loc="left")
    ticks = np.unique(np.linspace(0, count - 1, min(count, 11)).round().astype(int))
    axes.set_xticks(ticks, [str(steps[i]) for i in ticks])
    figure.colorbar(image, ax=axes, label="relative error of the residual, power of ten")
    return figure


def _map(width: float, height: float, kinds: Sequence[str], told: str) -> tuple[Figure, Axes]:
    """A figure of moderate size and its axes, with steps across and a row for each block."""
    figure = new_figure(min(width, 12.0), min(height, 14.0), told)
    axes = figure.add_subplot()
    names = [f"{_ABBREVIATIONS.get(kind, kind[:12])} {b}" for b, kind in enumerate(kinds)]
    axes.set_yticks(range(len(kinds)), names, fontsize=7)
    axes.set(xlabel=STEPS_AXIS, ylabel="residual block")
    axes.locator_params(axis="x", integer=True)
    return figure, axes
