"""A chunk of actions as curves, one for each number of the action."""

from __future__ import annotations

from pathlib import Path

from ..core.spec import FloatArray
from .figure import new_figure, write_picture


def plot_chunk(actions: FloatArray, executed: range, path: str | Path, title: str) -> None:
    """Draw the actions ``[T, Da]``, with the executed steps shaded, and write the picture; see ``write_picture``."""
    figure = new_figure(8, 4, "the actions")
    axes = figure.subplots()
    axes.axvspan(executed.start - 0.5, executed.stop - 0.5, color="#e8e8e8", label="executed")
    for number, curve in enumerate(actions.T):
        axes.plot(range(len(curve)), curve, marker=".", linewidth=1.2, label=f"{number}")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), ncols=1 + actions.shape[1] // 16)
    axes.set(xlabel="step of the chunk", ylabel="action, in its units")
    axes.set_title(title, fontsize=10, loc="left")
    write_picture(figure, path)
