"""What an artifact is, as a JSON document: what ``inspect --json`` prints."""

from dataclasses import asdict
from typing import Any

from ..artifact.load import Artifact
from ..artifact.manifest import Manifest
from ..artifact.view import view_of
from ..core.envelope import FAR
from ..ir.flops import graph_flops
from ..ir.pieces import frame_name
from ..runtimes.liveness import rollout_needs
from .facts import plan_flops, plans_of
from .usage import uses


def document(artifact: Artifact) -> dict[str, Any]:
    """Everything that an artifact says of itself, as plain JSON values; FLOPs of a frame piece are those of a row."""
    manifest = artifact.manifest
    spec = manifest.spec
    return {
        "path": str(artifact.path),
        "identity": manifest.identity,
        "model_identity": manifest.model_identity,
        "schema_version": manifest.schema_version,
        "ttscompile_version": manifest.ttscompile_version,
        "source": dict(spec.source),
        "sampler": {name: getattr(spec.sampler, name) for name in ("name", "steps", "stochastic", "clip")},
        "sample": list(spec.sample),
        "left_out": spec.left_out,
        "observations": {
            key: {"shape": list(one.shape), "dtype": one.dtype, "any_size": one.fit is not None}
            for key, one in spec.observations.items()
        },
        "chunk": {"action_dim": spec.chunk.action_dim, "start": spec.chunk.start, "stop": spec.chunk.stop},
        "blocks": [
            {"index": i, "kind": b.kind, "type": str(b.type), "group": b.group, "flops": b.flops, "reason": b.reason}
            for i, b in enumerate(manifest.blocks)
        ],
        "precision": _precision(manifest),
        "frames": [
            {"piece": frame_name(i), "rows": n, "flops": graph_flops(tower)}
            for i, (n, tower) in enumerate(zip(artifact.pieces.rows, artifact.pieces.towers, strict=True))
        ],
        "tokens": {name: {"tokens": one.tokens, "fixed": one.fixed} for name, one in manifest.tokens.items()},
        "loops": {
            **{loop: {"sampler": table.name, "steps": table.steps} for loop, table in spec.all_loops.items()},
            **{loop: {"last_steps_of": one.loop, "steps": one.steps} for loop, one in manifest.starts.items()},
        },
        "flops": {  # of one call of one stream, every cell computed; ``captured`` is the policy as it came
            "captured": manifest.flops.dense,
            "prologue": manifest.flops.prologue,
            "pruner": manifest.flops.pruner,
            "stems_and_tails": manifest.steps * (manifest.flops.stem + manifest.flops.tail),
            "blocks": manifest.steps * sum(manifest.flops.blocks),
        },
        "ceiling": {"sparsity": 1 - 1 / manifest.steps, "flops": manifest.flops.ceiling(manifest.steps)},
        "plans": {
            name: asdict(plan) | {"flops": plan_flops(artifact, name)} for name, plan in plans_of(manifest).items()
        },
        "uses": [asdict(use) for use in uses(artifact)],
        "rollout_cache": asdict(rollout_needs(view_of(artifact))),
        "default_plan": manifest.default_plan,
        "envelope": None if artifact.envelope is None else {"components": len(artifact.envelope.center), "far": FAR},
        "calibration": None if manifest.calibration is None else dict(manifest.calibration),
    }


def _precision(manifest: Manifest) -> dict[str, Any]:
    """Of the weights: in which parts, and which stay fp32 because it was asked for."""
    record = manifest.precision
    if record is None:
        return {"name": manifest.precision_name, "blocks": 0, "bytes": 0, "parts": [], "asked": []}
    size = sum(manifest.files[name].bytes for name in (record.weights, *record.models.values()))
    parts = {"parts": list(record.kept), "asked": list(record.asked)}
    return {"name": record.name, "blocks": record.blocks, "bytes": size, **parts}
