"""A picture of traces, one beside the other: what the control loop got, and what the policy was doing meanwhile."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

TICKS = {
    "tick": ("#2a9d5c", "action"),
    "reserve": ("#b3b032", "chunk late: from its reserve"),
    "hold": ("#e9a23b", "last action held"),
    "starved": ("#d03b3b", "no action (yet)"),
}
CALLS = {"scheduled": "#4477aa", "overdue": "#d03b3b", "discarded": "#bbbbbb", "refused": "#aa3377"}
LABELS = {"scheduled": "inference", "overdue": "inference, too late to use", "discarded": "inference, reset meanwhile"}


def plot_traces(traces: Mapping[str, Path], output: Path, window: float) -> None:
    """Draw the traces of several runs.

    Args:
        traces: title -> file that ``AsyncExecutor.trace`` wrote.
        output: picture to write, ``.png``, ``.svg`` or ``.pdf``.
        window: seconds to show, from the first reset on.
    """
    columns = 2 if len(traces) > 1 else 1
    rows = -(-len(traces) // columns)
    figure = Figure(figsize=(7 * columns, 1.9 * rows + 0.9), layout="constrained")
    # Runs come policy by policy: one policy a column, one rate a row.
    titles = list(traces)
    for i, title in enumerate(titles):
        axes = figure.add_subplot(rows, columns, 1 + (i % rows) * columns + i // rows)
        _draw(axes, _events(traces[title]), window)
        axes.set_title(title, loc="left")
    handles: list[Any] = [
        Line2D([], [], color=color, marker="|", linestyle="", markersize=10, markeredgewidth=2, label=label)
        for color, label in TICKS.values()
    ]
    handles += [Patch(color=CALLS[name], label=label) for name, label in LABELS.items()]
    handles.append(Line2D([], [], color="black", linestyle=":", label="reset"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(output, dpi=110)


def _events(path: Path) -> list[dict[str, Any]]:
    events: list[dict[str, Any]] = json.loads(path.read_text())["traceEvents"]
    return [event for event in events if event["ph"] in "Xi"]


def _draw(axes: Any, events: list[dict[str, Any]], window: float) -> None:
    resets = [event["ts"] / 1e6 for event in events if event["name"] == "reset"]
    start = resets[0] if resets else 0.0
    for name, (color, _) in TICKS.items():
        at = [event["ts"] / 1e6 - start for event in events if event["name"] == name]
        axes.vlines([t for t in at if 0 <= t <= window], 1.1, 1.9, color=color, linewidth=1.6)
    for event in events:
        begin = event["ts"] / 1e6 - start
        if event["name"] == "inference" and begin + event["dur"] / 1e6 >= 0 and begin <= window:
            color = CALLS[event["args"]["chunk"]]
            axes.broken_barh(
                [(begin, event["dur"] / 1e6)], (0.1, 0.8), facecolors=color, edgecolor="white", linewidth=0.5
            )
    for at in resets:
        if 0 <= at - start <= window:
            axes.axvline(at - start, color="black", linestyle=":", linewidth=1)
    axes.set(xlim=(0, window), ylim=(0, 2), yticks=[0.5, 1.5], yticklabels=["policy", "control loop"], xlabel="seconds")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
