"""A picture of where an artifact differs from the original: steps across, blocks down, colour by relative error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .figure import STEPS_AXIS, block_names, new_figure, write_picture

_LEAST, _MOST = -8.0, 0.0
"""Powers of ten at the ends of the colours: rounding, and another residual altogether."""


def plot_errors(
    errors: npt.NDArray[np.float64],
    steps: Sequence[int],
    kinds: Sequence[str],
    tolerance: float,
    path: str | Path,
    title: str = "",
    cells: npt.NDArray[np.bool_] | None = None,
    plan: str | None = None,
) -> None:
    """Draw relative errors of residuals, and write the picture.

    Args:
        errors: ``[A, blocks]``.
        steps: number of each of the A steps.
        kinds: kind of each block, in order of execution.
        tolerance: errors above it are framed.
        path: see ``write_picture``.
        title: over the picture.
        cells: bool ``[K, blocks]``, cells of a plan that are marked; None for none.
        plan: its name.

    Raises:
        RuntimeUnavailableError: matplotlib is not installed.
        OutputError: the picture cannot be written.
    """
    count, blocks = errors.shape
    size = min(6.5 + 0.03 * count, 12.0), min(2.2 + 0.17 * blocks, 14.0)
    figure = new_figure(*size, "a picture of the errors", "the errors")
    axes = figure.add_subplot()
    shown = np.log10(np.clip(np.nan_to_num(errors, nan=1.0, posinf=1.0), 10**_LEAST, 10**_MOST)).T
    image = axes.imshow(shown, cmap="viridis", vmin=_LEAST, vmax=_MOST, aspect="auto", interpolation="none")
    above = np.argwhere(~(errors <= tolerance))
    if len(above):
        axes.scatter(above[:, 0], above[:, 1], s=9, marker="s", facecolors="none", edgecolors="#d55e00", linewidths=0.9)
    marked = 0
    if cells is not None:
        columns = {step: column for column, step in enumerate(steps)}
        places = [(columns[k], b) for k, b in np.argwhere(cells).tolist() if k in columns]
        marked = len(places)
        if places:
            across, down = zip(*places, strict=True)
            axes.scatter(across, down, s=12, marker="x", color="#f0e442", linewidths=0.9)
    ticks = np.unique(np.linspace(0, count - 1, min(count, 11)).round().astype(int))
    axes.set_xticks(ticks, [str(steps[i]) for i in ticks])
    axes.set_yticks(range(blocks), block_names(kinds), fontsize=7)
    axes.set_xlabel(STEPS_AXIS)
    axes.set_ylabel("residual block")
    told = f"{len(above)} of {errors.size} residuals differ by more than {tolerance:g} (framed)"
    if plan is not None:
        told += f"; {marked} cells of plan {plan!r} are not those stored (crossed)"
    axes.set_title(f"{title}\n{told}" if title else told, fontsize=9, loc="left")
    bar = figure.colorbar(image, ax=axes)
    bar.set_label("relative error of the residual, power of ten")
    write_picture(figure, path)
