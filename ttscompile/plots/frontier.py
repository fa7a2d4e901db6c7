"""The pictures of a comparison: latency across, distance from the original up; and chunks of actions as curves."""

from __future__ import annotations

from collections.abc import Sequence
from math import log, sqrt
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.spec import FloatArray
from ..measure.points import FarCall, Point
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


def plot_frontier(points: Sequence[Point], efficient: Sequence[Point], title: str, hollow: str = "") -> Figure:
    """The points of all series, and a line along ``efficient``, those that no other beats, the fastest first.

    Those of the series ``hollow`` are grey rings. Those at no distance but rounding (the dense policy) are told in the
    title.
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
            color="#999999" if series == hollow else COLOURS[i % len(COLOURS)],
            fillstyle="none" if series == hollow else "full",
            label=series,
        )
    first, last = (log(end([p.latency_ms for p in shown], default=1.0)) for end in (min, max))
    told = shown if len(shown) <= MOST_NAMES else [p for p in shown if p in efficient]
    several = len({p.name for p in told}) < len(told)  # proposers have a plan of the same name each
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


MOST_NUMBERS = 3
"""Of the action, that are drawn of a call: those in which it differs most."""


def plot_calls(shown: Sequence[tuple[str, FarCall]]) -> Figure:
    """A row for each call under its title: what the cameras saw, and the numbers of the action that differ most.

    Of each number what the original and the plan execute with the same noise, and, thin, with other noise.
    """
    cameras = max(len(call.pictures) for _, call in shown)
    columns = cameras + min(len(shown[0][1].numbers), MOST_NUMBERS)
    figure = new_figure(1.0 + 2.2 * columns, 0.5 + 1.9 * len(shown), "the calls")
    panels = figure.subplots(len(shown), columns, squeeze=False)
    for row, (title, call) in zip(panels, shown, strict=True):
        for axes, picture in zip(row, call.pictures.values(), strict=False):
            axes.imshow(np.moveaxis(picture, 0, -1).clip(0, 1), cmap="gray")
            axes.set_axis_off()
        for axes, n in zip(row[cameras:], call.numbers, strict=False):
            original, own = call.actions[..., n]
            axes.plot(original[1:].T, color="#cccccc", linewidth=1.6, label="the original, other noise")
            axes.plot(own[1:].T, color=COLOURS[0], linewidth=0.5, alpha=0.6, label="the plan, other noise")
            axes.plot(original[0], color=COLOURS[1], linewidth=1.6, label="the original")
            axes.plot(own[0], color=COLOURS[0], marker=".", linestyle="none", label="the plan")
            axes.set_ylabel(f"number {n}", fontsize=7, labelpad=1)
            axes.locator_params(axis="x", integer=True)
            axes.tick_params(labelsize=6)
        row[0].set_title(title, fontsize=8, loc="left")
    known = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(known.values(), known, loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    return figure
