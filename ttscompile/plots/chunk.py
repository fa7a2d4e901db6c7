"""Chunks of actions as curves, one for each number of the action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..core.spec import FloatArray
from ..measure.points import MeasuredPoint
from .figure import new_figure
from .frontier import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_chunk(actions: FloatArray, executed: range, title: str) -> Figure:
    """The actions ``[T, Da]``, with the executed steps shaded."""
    figure = new_figure(8, 4, "the actions")
    axes = figure.subplots()
    axes.axvspan(executed.start - 0.5, executed.stop - 0.5, color="#e8e8e8", label="executed")
    for number, curve in enumerate(actions.T):
        axes.plot(range(len(curve)), curve, marker=".", linewidth=1.2, label=f"{number}")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), ncols=1 + actions.shape[1] // 16)
    axes.set(xlabel="step of the chunk", ylabel="action, in its units")
    axes.set_title(title, fontsize=10, loc="left")
    return figure


def plot_calls(points: Sequence[MeasuredPoint]) -> Figure:
    """The furthest calls, a row for each of the first eight plans; lines are the original, dots the plan."""
    shown = points[:8]
    width = 1 + max(len(call.pictures) for p in shown for call in p.furthest)  # of a call
    across = width * max(len(p.furthest) for p in shown)
    figure = new_figure(2.2 * across, 2.4 * len(shown), "the calls")
    for row, p in enumerate(shown):
        for column, call in enumerate(p.furthest):
            place = row * across + column * width + 1
            for number, picture in enumerate(call.pictures.values()):
                camera = figure.add_subplot(len(shown), across, place + number)
                camera.imshow(np.moveaxis(picture, 0, -1).clip(0, 1), cmap="gray")
                camera.set_axis_off()
            axes = figure.add_subplot(len(shown), across, place + width - 1)
            for number, (theirs, own) in enumerate(zip(*np.swapaxes(call.actions, 1, 2), strict=True)):
                axes.plot(theirs, color=COLOURS[number % len(COLOURS)], linewidth=1)
                axes.plot(own, color=COLOURS[number % len(COLOURS)], marker=".", linestyle="none")
            told = f"{p.series}: {p.name}\nepisode {call.episode}, call {call.call}:\ndistance {call.distance:.2f}"
            axes.set_title(told, fontsize=7, loc="left")
            axes.tick_params(labelsize=6)
    return figure
