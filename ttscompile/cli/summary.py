"""What an artifact is, as tables: for ``convert``, ``calibrate`` and ``inspect``."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import abbreviated
from ttscompile.cli.output import flops, print_table, share, table
from ttscompile.report import facts
from ttscompile.report.summary import document


def print_summary(artifact: Artifact, console: Console) -> None:
    """What an artifact is, as tables."""
    summary, manifest = document(artifact), artifact.manifest
    captured = summary["flops"]["captured"]
    sampler, chunk = summary["sampler"], summary["chunk"]
    horizon, channels = summary["sample"]
    about = table("artifact", summary["path"])
    about.columns[1].justify = "left"
    about.add_row("identity", abbreviated(summary["identity"]))
    about.add_row("from", ", ".join(f"{k} {v}" for k, v in summary["source"].items()) or "a module")
    about.add_row(
        "sampler", f"{sampler['name']}, K = {sampler['steps']} steps" + ", draws noise" * sampler["stochastic"]
    )
    for key, observation in summary["observations"].items():
        about.add_row(f"observation {key!r}", f"{observation['dtype']}{observation['shape']} a stream")
    about.add_row(
        "action",
        f"{horizon} steps of {chunk['action_dim']}, of which {chunk['start']}..{chunk['stop'] - 1} are executed"
        + (f"; {summary['left_out']} more are left out" if summary["left_out"] else "")
        + (f"; the sample has {channels} channels" if channels != chunk["action_dim"] else ""),
    )
    cache = summary["rollout_cache"]
    about.add_row(
        "rollout cache",
        f"{cache['read']} of {cache['cells']} residuals a stream, {cache['bytes_read'] / 1e6:.1f} MB, for its plans;"
        f" {cache['bytes_most'] / 1e6:.1f} MB for plans that you give",
    )
    about.add_row("precision", _told_precision(summary["precision"], len(summary["blocks"])))
    console.print(about)
    print_table(facts.block_table(manifest), console)
    costs = table("FLOPs a call, one stream", "", "of the captured policy")
    for name, count in summary["flops"].items():
        costs.add_row(name.replace("_", " "), flops(count), share(count / captured))
    console.print(costs)
    print_table(facts.plan_table(artifact), console)
    record = manifest.calibration
    if record is None:
        console.print("Not calibrated: every call is dense. Run 'ttscompile calibrate' to give it a plan.")
        return
    print_table(facts.score_table(record), console)
    for line in facts.left_out(record):
        console.print(f"  {line}")  # as a row it would squeeze the figures
    print_table(facts.record_table(record, most=90), console)


def _told_precision(precision: dict[str, Any], blocks: int) -> str:
    """The same as one line."""
    if not precision["blocks"]:
        return f"{precision['name']}"
    told = f"{precision['name']} weights in {precision['blocks']} of {blocks} blocks, {precision['bytes'] / 1e6:.1f} MB"
    error = precision["error"]
    if error is None:
        return f"{told}; its action error was not measured"
    return (
        f"{told}; dense actions {error['mean']:.4g} from fp32 on average, 90th percentile {error['p90']:.4g}"
        f" ({error['calls']} random observations, equal noise)"
    )
