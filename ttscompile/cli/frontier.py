"""What a build tried, and what to do with what it chose."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from ttscompile.artifact.load import Artifact
from ttscompile.cli.output import print_identity, say, table
from ttscompile.core.plan import DENSE
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms
from ttscompile.report.facts import chosen, remarks


def print_frontier(artifact: Artifact, directory: Path, output: Console, threads: int) -> None:
    """The plans that were tried, the verdict on the default, and how to go on."""
    record, default = artifact.manifest.calibration or {}, artifact.manifest.default_plan
    rows = record["frontier"]
    dense = next(row for row in rows if row["name"] == DENSE)
    made = table("plan", "what it does", "ms a call", "longest", "times faster", "distance", "95 %", "")
    for row in rows:
        made.add_row(
            f"{row['name']} (default)" if row["name"] == default else row["name"],
            row["told"],
            ms(row["milliseconds"], 4),
            ms(row["worst"], 4),
            f"{dense['milliseconds'] / row['milliseconds']:.1f} x",
            f"{row['distance']:.3f}",
            "..".join(f"{one:.3f}" for one in row["interval"]),
            "" if row["near"] else "too far",
        )
    made.columns[1].justify = "left"
    output.print(made)
    say(
        output,
        "Times faster: than the same policy with every step computed, compiled too. Distance: between the actions and"
        " the original's, in units of what other noise changes; 0 is the same. Held-out episodes:"
        f" {len(record['episodes']['validation'])}. One stream, {threads} thread{'s' * (threads > 1)}.",
        *(chosen(record) if record.get("other_noise") else remarks(record)),
        "",
        f"    policy = ttscompile.load({str(directory)!r}, threads={threads})",
        "    policy.reset()  # a new episode",
        "    actions = policy.predict_action(observation)['action']",
        "",
        one_line(fingerprint()),
    )
    print_identity(artifact.manifest.identity, output)
