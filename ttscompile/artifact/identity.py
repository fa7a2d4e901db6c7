"""What an artifact computes, as a hash: independent of paths, time, machine, and of how it was calibrated."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from ..ir.pieces import PRUNER
from .codec import to_json
from .manifest import Manifest
from .strict_json import dump_compact


def identities(manifest: Manifest) -> tuple[str, str]:
    """Identity and model identity of what a manifest describes; its own two fields are not read.

    The model identity covers weights, tables, graphs, sampler, normalisers, observations, chunk and block table. The
    identity covers that, the pruner's weights, all plans, which of them is the default, and blocks of another
    precision: a calibration, which computes in fp32, belongs to the model with or without them. Neither covers what
    people are told: source, FLOPs, reasons, sparsities, errors, calibration record, versions.

    Returns:
        Two sha256 of 64 digits.
    """
    document = to_json(manifest)
    hashes = {name: record.sha256 for name, record in manifest.files.items()}
    pieces = {name: _piece(piece, hashes) for name, piece in document["pieces"].items()}
    pruner = pieces.pop(PRUNER, None)
    model = {
        "spec": {key: value for key, value in document["spec"].items() if key != "source"},
        "blocks": [{key: block[key] for key in ("kind", "type", "group")} for block in document["blocks"]],
        "pieces": pieces,
        "contexts": document["contexts"],
        "features": document["features"],
        "program": hashes[manifest.stores.program],
        "weights": hashes[manifest.stores.weights],
    }
    model_identity = _hash(model)
    whole: dict[str, Any] = {
        "model": model_identity,
        "pruner": [pruner, _optional(hashes, manifest.stores.pruner)],
        "plans": [_optional(hashes, manifest.stores.plans), {n: plan.kind for n, plan in manifest.plans.items()}],
        "default_plan": manifest.default_plan,
    }
    if manifest.precision is not None:
        record = manifest.precision
        models = {name: hashes[file] for name, file in record.models.items()}
        whole["precision"] = {"name": record.name, "weights": hashes[record.weights], "models": models}
    return _hash(whole), model_identity


def _piece(piece: Mapping[str, Any], hashes: Mapping[str, str]) -> dict[str, Any]:
    return {**piece, "file": hashes[piece["file"]]}


def _optional(hashes: Mapping[str, str], name: str | None) -> str | None:
    return None if name is None else hashes[name]


def _hash(document: object) -> str:
    return hashlib.sha256(dump_compact(document)).hexdigest()
