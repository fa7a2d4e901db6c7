"""Draws equal_time.png: how far schedules are from the original at equal milliseconds, and with our correction.

python docs/pictures/equal_time.py [FILE]
python docs/pictures/equal_time.py [FILE] "Meta-World=metaworld.json"

It reads ``docs/evidence/equal_time.json``. The second command first puts there what ``examples/benchmark/rivals.py
--even-steps ... --correct --json`` printed of a policy, in the place of what was there of it. What fits a correction of
its own is in both panels of a row.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ttscompile.calibration.proposers import SCHEDULES
from ttscompile.plots.figure import plain_powers, with_grid
from ttscompile.plots.frontier import COLOURS, MARKERS

CORRECTING = [one.name for one in SCHEDULES if one.corrects]

SHADES = (*COLOURS, "#8c564b")

TABLE = Path(__file__).resolve().parents[1] / "evidence" / "equal_time.json"

NEAREST = 0.02
"""What is nearer is drawn here: intervals of these distances are wider, and estimates may be below 0."""

PANELS = {"as published": False, "with our correction": True}

Rows = Sequence[Mapping[str, Any]]


def rows_of(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of each plan that was found, and of the dense one, what the table keeps."""
    made = []
    for point in document["comparison"]["points"]:
        name, _, pace = point["name"].partition("-as-")  # of plans that a run before had written
        series = point["series"] if point["series"] != "this artifact" else name.replace("-corrected", ", corrected")
        proposer, _, corrected = series.partition(", ")
        share = document["shares"].get(point["series"], {}).get(point["name"])  # None of what was not held to a pace
        made.append(
            {
                "proposer": proposer,
                "corrected": bool(corrected),
                "as": pace or name.removeprefix("as-"),
                "reused": round(point["sparsity"], 4),
                "ms": round(point["latency_ms"], 2),
                "share": share and round(share, 3),
                "distance": round(point["distance"], 3),
                "interval": [round(end, 3) for end in point["interval"]],
            }
        )
    return made


def keep(policy: str, document: Mapping[str, Any], table: Path = TABLE) -> None:
    """Put the rows of a policy into the table, a row a line."""
    found = json.loads(table.read_text()) if table.exists() else {}
    found[policy] = rows_of(document)
    parts = (
        f" {json.dumps(name)}: [\n" + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "\n ]"
        for name, rows in found.items()
    )
    table.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def panel(axes: Any, rows: Rows, names: Sequence[str], corrected: bool) -> None:
    """One way to run all proposers: a line for each, from the shorter calls to the longer ones."""
    for number, name in enumerate(names):
        wanted = corrected and name not in CORRECTING
        own = sorted(
            (row["ms"], max(row["distance"], NEAREST))
            for row in rows
            if (row["proposer"], row["corrected"]) == (name, wanted)
        )
        if own:
            style: dict[str, Any] = {"marker": MARKERS[(number + number // len(SHADES)) % len(MARKERS)]}
            style |= {"color": SHADES[number % len(SHADES)], "linewidth": 2.2 if name in CORRECTING else 1}
            axes.plot(*zip(*own, strict=True), label=name, **style)
    axes.set(xscale="log", yscale="log")
    plain_powers(axes.xaxis)
    plain_powers(axes.yaxis)
    with_grid(axes)


def draw(path: Path, table: Path = TABLE) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    policies: Mapping[str, Rows] = json.loads(table.read_text())
    figure = Figure(figsize=(9, 3.6 * len(policies) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(policies), 2, squeeze=False, sharex="row", sharey="row")
    known = {row["proposer"] for rows in policies.values() for row in rows}
    names, named = [one.name for one in SCHEDULES if one.name in known], dict[str, Any]()
    for row, (policy, rows) in zip(grid, policies.items(), strict=True):
        dense = next(each["ms"] for each in rows if each["proposer"] == "dense")
        for axes, (title, corrected) in zip(row, PANELS.items(), strict=True):
            panel(axes, rows, names, corrected)
            axes.set_title(f"{policy}, {title} (all steps: {dense:.3g} ms)", fontsize=9)
            axes.set_xlabel("milliseconds of a call")
            named |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        row[0].set_ylabel("distance from the original")
    figure.legend([named[one] for one in names], names, loc="outside lower center", ncols=6, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    files = [one for one in sys.argv[1:] if "=" not in one]
    for one in sys.argv[1:]:
        if "=" in one:
            keep(one.partition("=")[0], json.loads(Path(one.partition("=")[2]).read_text()))
    draw(Path(files[0]) if files else Path(__file__).with_name("equal_time.png"))
