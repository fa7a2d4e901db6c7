"""What an artifact is, as tables: for ``convert``, ``calibrate`` and ``inspect``."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.padding import Padding

from ttscompile.artifact.ceiling import uncalibrated
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli.output import print_json, results, table
from ttscompile.report import Table, facts, usage
from ttscompile.report.summary import document


def print_written(directory: Path, as_json: bool) -> None:
    """What the artifact in a directory is now: as tables, or as one JSON document."""
    artifact = load_artifact(directory)
    if as_json:
        print_json(document(artifact))
    else:
        print_summary(artifact, results())


def print_summary(artifact: Artifact, console: Console) -> None:
    """What an artifact is, as the tables of its page: what it does first, then what it is made of."""
    manifest = artifact.manifest
    source = ", ".join(f"{k} {v}" for k, v in manifest.spec.source.items()) or "a module"
    rows = [("identity", manifest.short_identity), ("made from", source), *facts.policy(artifact).tables[0].rows]
    about = table("artifact", str(artifact.path), rows=rows)
    about.columns[1].justify = "left"
    console.print(about)
    print_facts(console, facts.plan_table(artifact))
    record = manifest.calibration
    if record is None:
        console.print(Padding(uncalibrated(manifest), (0, 0, 1, 2)))
    else:
        print_facts(console, facts.score_table(record))
        for line in facts.remarks(record):
            console.print(Padding(line, (0, 0, 0, 2)))  # as a row it would squeeze the figures
    for made in (facts.block_table(manifest), *facts.hoisting(artifact).tables, usage.usage_table(artifact)):
        print_facts(console, made)
    console.print(Padding(usage.told_unused(artifact), (0, 0, 0, 2)))
    if record is not None:
        print_facts(console, facts.record_table(record, most=90))


def print_facts(console: Console, made: Table) -> None:
    """A table of the page; nothing if it has no rows."""
    if made.rows:
        shown = table(*made.head, rows=made.rows)
        for column, words in zip(shown.columns, made.text, strict=True):
            column.justify = "left" if words else "right"
        console.print(shown)
