"""What an artifact is, for ``convert`` and ``inspect``: as a JSON document, and that document as tables."""

from __future__ import annotations

from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import Console

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.manifest import DENSE, Manifest, abbreviated
from ttscompile.cli.output import flops, marked, share, table
from ttscompile.measure.units import plain
from ttscompile.runtimes.onnxruntime.liveness import rollout_needs


def document(directory: Path, artifact: Artifact | None = None) -> dict[str, Any]:
    """Everything that ``inspect --json`` says.

    Args:
        directory: of the artifact, for people.
        artifact: the same opened; None opens and checks it.

    Raises:
        ArtifactError: it cannot be opened.
    """
    artifact = artifact or load_artifact(directory)
    manifest = artifact.manifest
    spec = manifest.spec
    sampler = spec.sampler
    return {
        "path": str(directory),
        "identity": manifest.identity,
        "model_identity": manifest.model_identity,
        "schema_version": manifest.schema_version,
        "ttscompile_version": manifest.ttscompile_version,
        "source": dict(spec.source),
        "sampler": {
            "name": sampler.name,
            "steps": sampler.steps,
            "stochastic": sampler.stochastic,
            "clip": sampler.clip,
        },
        "sample": list(spec.sample),
        "left_out": spec.left_out,
        "observations": {k: {"shape": list(o.shape), "dtype": o.dtype} for k, o in spec.observations.items()},
        "chunk": {"action_dim": spec.chunk.action_dim, "start": spec.chunk.start, "stop": spec.chunk.stop},
        "blocks": [
            {
                "index": i,
                "kind": block.kind,
                "type": str(block.type),
                "group": block.group,
                "flops": block.flops,
                "reason": block.reason,
            }
            for i, block in enumerate(manifest.blocks)
        ],
        "precision": _precision(manifest),
        "flops": _flops(manifest),
        "ceiling": {
            "sparsity": 1 - 1 / manifest.steps,
            "flops": manifest.flops.ceiling(manifest.steps),
        },
        "plans": _plans(artifact),
        "rollout_cache": asdict(rollout_needs(artifact)),
        "default_plan": manifest.default_plan,
        "calibration": None if manifest.calibration is None else dict(manifest.calibration),
    }


def _precision(manifest: Manifest) -> dict[str, Any]:
    """Of the blocks' weights, and what it does to the actions of dense calls; ``error`` is null for fp32."""
    record = manifest.precision
    if record is None:
        return {"name": manifest.precision_name, "blocks": 0, "bytes": 0, "error": None}
    size = sum(manifest.files[name].bytes for name in (record.weights, *record.models.values()))
    error = None if record.error is None else dict(vars(record.error))
    return {"name": record.name, "blocks": record.blocks, "bytes": size, "error": error}


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


def _flops(manifest: Manifest) -> dict[str, int]:
    """FLOPs of one call of one stream, every cell computed; ``captured`` is the policy as it came."""
    record, steps = manifest.flops, manifest.steps
    return {
        "captured": record.dense,
        "prologue": record.prologue,
        "pruner": record.pruner,
        "stems_and_tails": steps * (record.stem + record.tail),
        "blocks": steps * sum(record.blocks),
    }


def _plans(artifact: Artifact) -> dict[str, dict[str, Any]]:
    manifest = artifact.manifest
    plans: dict[str, dict[str, Any]] = {
        DENSE: {
            "kind": "schedule",
            "sparsity": 0.0,
            "flops_sparsity": 0.0,
            "flops": manifest.flops.call(artifact.schedule(DENSE), pruned=False),
        }
    }
    blocks = manifest.steps * sum(manifest.flops.blocks)
    for name, plan in manifest.plans.items():
        pruned = plan.kind == "pruner"
        # The fixed share is a call without one block; a pruner's blocks cost what was measured on average.
        computed = None if plan.flops_sparsity is None else blocks * (1 - plan.flops_sparsity)
        fixed = manifest.flops.call(artifact.schedule(DENSE), pruned=pruned) - blocks
        plans[name] = {
            "kind": plan.kind,
            "sparsity": plan.sparsity,
            "flops_sparsity": plan.flops_sparsity,
            "flops": None if computed is None else fixed + computed,
        }
    return plans


def print_summary(summary: dict[str, Any], console: Console) -> None:
    """The document as tables."""
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
    console.print(_block_table(summary["blocks"]))
    costs = table("FLOPs a call, one stream", "", "of the captured policy")
    for name, count in summary["flops"].items():
        costs.add_row(name.replace("_", " "), flops(count), share(count / captured))
    console.print(costs)
    plans = table("plan", "kind", "cells reused", "FLOPs reused", "FLOPs a call", "of the captured policy")
    for name, plan in summary["plans"].items():
        plans.add_row(
            f"{name} (default)" if name == summary["default_plan"] else marked(name),
            plan["kind"],
            share(plan["sparsity"]),
            share(plan["flops_sparsity"]),
            "" if plan["flops"] is None else flops(plan["flops"]),
            "" if plan["flops"] is None else share(plan["flops"] / captured),
        )
    console.print(plans)
    _print_calibration(summary["calibration"], console)


def _block_table(blocks: list[dict[str, Any]]) -> Any:
    """Blocks, with repeated layers told once: ``0, 3, .. 21``."""
    made = table("block", "kind", "residual", "group", "FLOPs, one evaluation")

    def alike(block: dict[str, Any]) -> tuple[Any, ...]:
        return block["group"], block["kind"], block["type"], block["flops"], block["reason"]

    for (group, kind, type_, cost, reason), members in groupby(sorted(blocks, key=alike), alike):
        indices = [str(block["index"]) for block in members]
        shown = ", ".join(indices if len(indices) <= 4 else [*indices[:2], "..", indices[-1]]) + f" ({len(indices)})"
        made.add_row(shown, kind + (f": {reason}" if reason else ""), type_, str(group), flops(cost))
    return made


def _print_calibration(record: dict[str, Any] | None, console: Console) -> None:
    if record is None:
        console.print("Not calibrated: every call is dense. Run 'ttscompile calibrate' to give it a plan.")
        return
    scores = table("held-out episodes", "mean action error", "90th percentile", "cells reused", "FLOPs saved")
    for name, score in record.get("plans", {}).items():
        errors = (f"{score[key]:.4g}" for key in ("error", "error_p90"))
        scores.add_row(marked(name), *errors, *(share(score[key]) for key in ("sparsity", "flops_saved")))
    precision = record.get("precision", {"plans": {}})
    for name, score in precision["plans"].items():
        errors = (f"{score[key]:.4g}" for key in ("error", "error_p90"))
        scores.add_row(f"{name}: {precision['name']} against fp32", *errors, "", "")
    if scores.row_count:
        console.print(scores)
    for name, reason in record.get("skipped", {}).items():
        console.print(f"  {name}: none, {reason}")  # as a row it would squeeze the figures
    made = table("calibration", "")
    for name, value in record.items():
        if name in ("plans", "precision", "sparsity", "flops_sparsity", "skipped"):
            continue  # told above
        told = plain(value)
        if isinstance(value, list | dict) and len(told) > 90:
            told = f"{len(value)} entries; see --json"
        made.add_row(name.replace("_", " "), told)
    console.print(made)
