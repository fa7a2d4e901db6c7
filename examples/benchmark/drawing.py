"""The picture of a sweep: latency against sparsity, a line for each thread count, and the floor under it.

    python examples/benchmark/drawing.py build/benchmark.json build/benchmark.png

Both axes are logarithmic, the horizontal one in the share of *computed* cells, so that a floor is a straight line.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import click
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")
"""Of thread counts, in order; from Okabe and Ito's palette, which colour-blind readers can tell apart."""
PYTORCH: Mapping[str, Literal[":", "-."]] = {"eager PyTorch": ":", "torch.compile": "-."}
"""Line styles."""

Rows = Sequence[Mapping[str, Any]]


def draw(document: Mapping[str, Any], path: Path) -> None:
    """Draw a document of ``sweep.py --json``: a row of panels for each width, a column for each loop."""
    rows: Rows = document["rows"]
    widths = list(dict.fromkeys((row["network"], row["width"]) for row in rows))
    loops = list(dict.fromkeys(row["loop"] for row in rows))
    threads = sorted({row["threads"] for row in rows})
    colours = {count: COLOURS[i % len(COLOURS)] for i, count in enumerate(threads)}
    figure = Figure(figsize=(max(1.2 + 3.9 * len(loops), 7.0), 1.6 + 3.3 * len(widths)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(widths), len(loops), squeeze=False, sharey="row")
    for i, (name, width) in enumerate(widths):
        for j, loop in enumerate(loops):
            own = [row for row in rows if (row["network"], row["width"], row["loop"]) == (name, width, loop)]
            _panel(panels[i][j], own, colours)
            panels[i][j].set_title(f"{name}, width {width}, {loop}", fontsize=10, loc="left")
            panels[i][j].tick_params(labelleft=True)
        panels[i][0].set_ylabel("ms a call, median; bars p10 to p90")
    for panel in panels[-1]:
        panel.set_xlabel("share of cells reused")
    columns = 3 * min(len(loops), 2)
    figure.legend(handles=_legend(rows, colours), loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    machine = document["machine"]
    versions = ", ".join(f"{k} {machine[k]}" for k in ("onnxruntime", "torch") if k in machine)
    figure.suptitle(f"{machine['processor']}, {machine['cores']} cores; {versions}", fontsize=9, color="#555555")
    figure.savefig(path, dpi=130, metadata={"Software": None} if path.suffix == ".png" else None)


def _panel(axes: Axes, rows: Rows, colours: Mapping[int, str]) -> None:
    sparse = [row for row in rows if row["sparsity"] is not None]
    for threads, colour in colours.items():
        own = [row for row in sparse if row["threads"] == threads]
        shares = [1 - row["sparsity"] for row in own]
        middle = [row["median_ms"] for row in own]
        around = [[row["median_ms"] - row["p10_ms"] for row in own], [row["p90_ms"] - row["median_ms"] for row in own]]
        axes.errorbar(shares, middle, around, color=colour, marker="o", markersize=4, capsize=2, linewidth=1.6)
        axes.plot(shares, [row["floor_ms"] for row in own], color=colour, linestyle="--", linewidth=1)
        for contestant, style in PYTORCH.items():
            for row in rows:
                if (row["contestant"], row["threads"]) == (contestant, threads):
                    axes.axhline(row["median_ms"], color=colour, linestyle=style, linewidth=1, alpha=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.invert_xaxis()
    axes.set_xticks(sorted({1 - row["sparsity"] for row in sparse}))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{1 - share:.0%}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda ms, _: f"{ms:g}"))
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend(rows: Rows, colours: Mapping[int, str]) -> list[Line2D]:
    found = {row["contestant"] for row in rows}
    lines = [
        Line2D([], [], color=colour, marker="o", markersize=4, label=f"{threads} thread{'s' * (threads > 1)}")
        for threads, colour in colours.items()
    ]
    lines.append(Line2D([], [], color="#555555", linestyle="--", linewidth=1, label="floor: arithmetic alone"))
    return lines + [
        Line2D([], [], color="#555555", linestyle=style, linewidth=1, label=label)
        for label, style in PYTORCH.items()
        if label in found
    ]


@click.command()
@click.argument("results", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("picture", type=click.Path(dir_okay=False, path_type=Path))
def main(results: Path, picture: Path) -> None:
    """Draw RESULTS, a document that sweep.py printed with --json, as PICTURE."""
    draw(json.loads(results.read_text()), picture)


if __name__ == "__main__":
    main()
