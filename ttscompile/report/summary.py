"""What an artifact is, as a JSON document: what ``inspect --json`` prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ..artifact.load import Artifact
from ..artifact.manifest import DENSE, Manifest
from ..runtimes.liveness import rollout_needs
from .facts import plan_flops


def document(artifact: Artifact) -> dict[str, Any]:
    """Everything that an artifact says of itself, as plain JSON values."""
    manifest = artifact.manifest
    spec = manifest.spec
    sampler = spec.sampler
    return {
        "path": str(artifact.path),
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
        "plans": {
            name: {
                "kind": "schedule" if plan is None else plan.kind,
                "sparsity": 0.0 if plan is None else plan.sparsity,
                "flops_sparsity": 0.0 if plan is None else plan.flops_sparsity,
                "flops": plan_flops(artifact, name),
            }
            for name, plan in {DENSE: None, **manifest.plans}.items()
        },
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
