"""Score against the latency that a simulation was given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

import numpy as np
from bootstrap import Estimate
from delays_world import Setup

MARKERS = "osD^vP*"
"""Of the lines; their number and that of the colours have no common divisor."""
ASIDE = 0.1
"""Ticks by which lines are moved apart, so that their intervals can be told from each other."""


def plot_delays(scores: Mapping[Setup, Estimate], waiting: Estimate, path: Path, title: str) -> None:
    """Draw score and its 95 % interval against latency in ticks, a line for each setup, and write the picture.

    Args:
        scores: of the setups, all of one rate.
        waiting: score where the world waits for the policy: a band.
        path: of the picture.
        title: over it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.axhspan(waiting.low, waiting.high, color="#dddddd", zorder=0, label="the world waits, 95 % interval")
    axes.axhline(waiting.mean, color="#888888", linewidth=1, zorder=0)
    lines: dict[str, list[tuple[float, Estimate]]] = {}
    for setup, score in scores.items():
        lines.setdefault(setup.label, []).append((setup.latency_ms * setup.hz / 1e3, score))
    for number, (label, points) in enumerate(lines.items()):
        points.sort(key=lambda point: point[0])
        ticks = [tick + ASIDE * (number - (len(lines) - 1) / 2) for tick, _ in points]
        means = [score.mean for _, score in points]
        errors = [[score.mean - score.low for _, score in points], [score.high - score.mean for _, score in points]]
        marker = MARKERS[number % len(MARKERS)]
        axes.errorbar(ticks, means, yerr=errors, marker=marker, capsize=3, linewidth=1.2, label=label)
    hz = next(iter(scores)).hz
    axes.set_xlabel("latency of a call, ticks")
    above = axes.secondary_xaxis(
        "top", functions=(lambda ticks: np.multiply(ticks, 1e3 / hz), lambda ms: np.multiply(ms, hz / 1e3))
    )
    above.set_xlabel(f"ms at {hz:g} Hz")
    axes.set_ylabel("score, mean and 95 % interval")
    axes.set_ylim(0.0, 1.02)
    axes.grid(color="#eeeeee", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_title("\n".join(fill(line, 110) for line in title.splitlines()), fontsize=8, loc="left")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    figure.savefig(path, dpi=150, metadata={"Software": None} if path.suffix == ".png" else None)
