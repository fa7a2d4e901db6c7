"""The pictures of a comparison: latency across, distance from the original up; and chunks of actions as curves."""

from __future__ import annotations

from collections.abc import Sequence
from math import log, sqrt
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.spec import FloatArray
from ..measure.points import MeasuredPoint, Point
from .figure import beside, covered, new_figure, plain_powers, with_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Okabe and Ito's palette, without the yellow that white paper swallows."""

MARKERS = "osD^vP*"

MOST_NAMES = 12
"""Of more points only those that no other beats have their names beside them: the others would cover each other."""

ROUNDING = 1e-4
"""A plan that is nearer is the original but for rounding: drawn, it would take the axis from all others."""

_TITLE_WIDTH = 105  # characters


def plot_frontier(points: Sequence[Point], efficient: Sequence[Point], title: str) -> Figure:
    """The points of all series, and a line along ``efficient``, those that no other beats, the fastest first.

    Those at no distance but rounding (the dense policy) are told in the title.
    """
    figure = new_figure(7.5, 5.5)
    axes = figure.add_subplot()
    shown = [point for point in points if point.distance > ROUNDING]
    for i, series in enumerate(dict.fromkeys(point.series for point in shown)):
        own = sorted((p for p in shown if p.series == series), key=lambda p: p.latency_ms)
        axes.plot(
            [p.latency_ms for p in own],
            [p.distance for p in own],
            marker=MARKERS[(i + i // len(COLOURS)) % len(MARKERS)],  # of a colour that comes again, another
            linestyle="none" if len({p.name.strip("0123456789.") for p in own}) > 1 else "-",
            linewidth=1,
            color=COLOURS[i % len(COLOURS)],
            label=series,
        )
    first, last = (log(end([p.latency_ms for p in shown], default=1.0)) for end in (min, max))
    told = shown if len(shown) <= MOST_NAMES else [p for p in shown if p in efficient]
    several = len({p.name for p in told}) < len(told)  # strategies have a plan of the same name each
    taken = list[tuple[float, float, float]]()  # from where to where a name goes, and at which height
    for p in told:
        place = (log(p.latency_ms) - first) / ((last - first) or 1.0)
        name = f"{p.series} {p.name}" if several else p.name
        (left, right), high = covered(place, name), log(p.distance)
        above = 4 + 15 * sum(left < b and a < right and abs(high - y) < 0.2 for a, b, y in taken)
        taken.append((left, right, high))
        led: Any = {"arrowstyle": "-", "color": "#999999", "linewidth": 0.5} if above > 4 else None
        axes.annotate(name, (p.latency_ms, p.distance), fontsize=8, arrowprops=led, **beside(place, name, above))
    best = [point for point in efficient if point.distance > ROUNDING]
    if len(best) > 1:  # of one point there is no line
        line: dict[str, Any] = {"color": "#999999", "linewidth": 4, "alpha": 0.35, "zorder": 0}
        axes.step([p.latency_ms for p in best], [p.distance for p in best], where="post", label="frontier", **line)
    axes.set(xscale="log", xlabel="latency of a call, ms (median)", yscale="log")
    axes.set_ylabel("distance from the original on held-out calls\n(1: about what other noise changes)")
    plain_powers(axes.xaxis)
    plain_powers(axes.yaxis)
    axes.margins(x=0.08, y=0.1)
    low, high = axes.get_ylim()  # nearer than three digits tell apart is beside each other
    axes.set_ylim(min(low, sqrt(low * high) / 1.2), max(high, sqrt(low * high) * 1.2))
    exact = ", ".join(f"{p.name} of {p.series}, {p.latency_ms:.3g} ms" for p in points if p.distance <= ROUNDING)
    parts = [*title.splitlines(), *([f"not drawn, at no distance but rounding: {exact}"] if exact else [])]
    lines = [line for part in parts for line in wrap(part, _TITLE_WIDTH)]
    axes.set_title("\n".join(lines), fontsize=8, loc="left")
    with_grid(axes)
    if shown:  # else there is nothing to explain
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def plot_chunk(actions: FloatArray, executed: range, title: str) -> Figure:
    """The actions ``[T, Da]``, with the executed steps shaded."""
    figure = new_figure(8, 4, "the actions")
    axes = figure.subplots()
    axes.axvspan(executed.start - 0.5, executed.stop - 0.5, color="#e8e8e8", label="executed")
    for number, curve in enumerate(actions.T):
        axes.plot(range(len(curve)), curve, marker=".", linewidth=1.2, label=f"{number}")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), ncols=1 + actions.shape[1] // 16)
    axes.set(xlabel="step of the chunk", ylabel="action, in its units")
    axes.locator_params(axis="x", integer=True)
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
