"""What an artifact is, as tables: for ``convert``, ``calibrate`` and ``inspect``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.padding import Padding

from ttscompile.artifact.ceiling import uncalibrated
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli.output import print_json, results, table
from ttscompile.measure.units import flops, share
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
    """What an artifact is, as tables."""
    summary, manifest = document(artifact), artifact.manifest
    captured = summary["flops"]["captured"]
    sampler, chunk = summary["sampler"], summary["chunk"]
    horizon, channels = summary["sample"]
    action = f"{horizon} steps of {chunk['action_dim']}, of which {chunk['start']}..{chunk['stop'] - 1} are executed"
    if summary["left_out"]:
        action += f"; {summary['left_out']} more are left out"
    if channels != chunk["action_dim"]:
        action += f"; the sample has {channels} channels"
    cache = summary["rollout_cache"]
    kept = (
        f"{cache['read']} of {cache['cells']} residuals a stream, {cache['bytes_read'] / 1e6:.1f} MB, for its plans;"
        f" {cache['bytes_most'] / 1e6:.1f} MB for plans that you give"
    )
    rows = (
        ("identity", manifest.short_identity),
        ("from", ", ".join(f"{k} {v}" for k, v in summary["source"].items()) or "a module"),
        ("sampler", f"{sampler['name']}, K = {sampler['steps']} steps" + ", draws noise" * sampler["stochastic"]),
        *(
            (f"observation {k!r}", f"{o['dtype']}{o['shape']} a stream" + ", from pictures of any size" * o["any_size"])
            for k, o in summary["observations"].items()
        ),
        ("action", action),
        ("rollout cache", kept),
        ("precision", _told_precision(summary["precision"], len(summary["blocks"]))),
        *((f"piece {one['piece']}", _told_frames(one, captured)) for one in summary["frames"]),
        *((("envelope", _told_envelope(summary["envelope"])),) if summary["envelope"] else ()),
        *facts.tokens(manifest),
        *facts.starts(manifest),
    )
    about = table("artifact", summary["path"], rows=rows)
    about.columns[1].justify = "left"
    console.print(about)
    print_facts(console, facts.block_table(manifest))
    costs = [(name.replace("_", " "), flops(n), share(n / captured)) for name, n in summary["flops"].items()]
    console.print(table("FLOPs a call, one stream", "", "of the captured policy", rows=costs))
    print_facts(console, facts.plan_table(artifact))
    print_facts(console, usage.usage_table(artifact))
    console.print(Padding(usage.told_unused(artifact), (0, 0, 0, 2)))
    record = manifest.calibration
    if record is None:
        console.print(uncalibrated(manifest))
        return
    print_facts(console, facts.score_table(record))
    for line in facts.remarks(record):
        console.print(Padding(line, (0, 0, 0, 2)))  # as a row it would squeeze the figures
    print_facts(console, facts.record_table(record, most=90))


def print_facts(console: Console, made: Table) -> None:
    """A table of the page; nothing if it has no rows."""
    if made.rows:
        console.print(table(*made.head, rows=made.rows))


def _told_frames(piece: dict[str, Any], captured: float) -> str:
    rows = f"{piece['rows']} a call of {flops(piece['flops'])} each"
    return f"computed once a frame, {rows}: {share(piece['rows'] * piece['flops'] / captured)} of the captured policy"


def _told_envelope(envelope: dict[str, Any]) -> str:
    recorded = f"{envelope['components']} components of what was recorded"
    return f"{recorded}; beyond {envelope['far']:g} times the furthest call there is no correction"


def _told_precision(precision: dict[str, Any], blocks: int) -> str:
    if not precision["parts"]:
        return str(precision["name"])
    count = f"{precision['blocks']} of {blocks} blocks"
    parts = [count if part == "blocks" else part for part in precision["parts"]]
    told = f"{precision['name']} weights in {' and '.join(parts)}, {precision['bytes'] / 1e6:.1f} MB"
    return told + f"; {' and '.join(precision['asked'])} in fp32, as was asked" * bool(precision["asked"])
