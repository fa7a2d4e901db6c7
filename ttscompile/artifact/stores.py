"""Files of an artifact that an update writes anew: the plans' arrays, and the weights of a pruner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.envelope import Envelope
from ..core.plan import ORIGINAL, Plan
from ..ir.pieces import PRUNER, of_loop
from . import tensors
from .bind import bind, places_of
from .corrections import correction_arrays, envelope_arrays, require_fit
from .files import content_hash, describe, replace_file
from .load import Artifact
from .manifest import Manifest


def plan_arrays_of(
    manifest: Manifest, plans: Mapping[str, Plan], envelope: Envelope | None
) -> dict[str, npt.NDArray[Any]]:
    """Schedules and corrections of plans, and the envelope, by the names that they have in the file."""
    arrays = envelope_arrays(envelope)
    for name, record in manifest.plans.items():
        if record.kind == "schedule":
            arrays[name] = np.asarray(plans[name].cells)
    for name in manifest.plans:
        if (correction := plans[name].correction) is not None:
            require_fit(correction, manifest, plans[name].loop)
            arrays |= correction_arrays(name, correction)
    return arrays


def store_arrays(directory: Path, manifest: Manifest, store: str, arrays: Mapping[str, npt.NDArray[Any]]) -> Manifest:
    """Write the file of a store beside the old one; without arrays there is none."""
    files = {name: record for name, record in manifest.files.items() if name != getattr(manifest.stores, store)}
    stores: dict[str, Any] = {store: None}
    if arrays:
        content = tensors.serialize(arrays)
        path = directory / f"{store}-{content_hash(content)}.safetensors"
        replace_file(path, content)
        stores[store], files[path.name] = path.name, describe(path)
    return replace(manifest, files=files, stores=replace(manifest.stores, **stores))


def pruner_name(piece: str, content: bytes) -> str:
    """Of the files of a loop's pruner. Those of two loops are never one: a calibration may change either."""
    return f"{PRUNER}-{content_hash(content if piece == PRUNER else content + piece.encode())}"


def store_pruner(
    artifact: Artifact, manifest: Manifest, weights: Mapping[str, npt.NDArray[Any]], loop: str
) -> Manifest:
    """Write the weights of a loop's pruner, and its model that refers to them, beside the old ones."""
    import onnx

    own = artifact.pruner if loop == ORIGINAL else artifact.loop_pruners[loop]
    piece = PRUNER if loop == ORIGINAL else of_loop(PRUNER, loop)
    old = manifest.stores.pruner if loop == ORIGINAL else manifest.loop_pruners[loop]
    record = manifest.pieces[piece]
    values = {name: np.asarray(value) for name, value in weights.items()}
    expected = {name: (str(value.dtype), value.shape) for name, value in own.items()}
    tensors.check_arrays("pruner's weight", values, expected, artifact.path, "Calibrate this artifact again.")
    content = tensors.serialize(values)
    path = artifact.path / f"{pruner_name(piece, content)}.safetensors"
    replace_file(path, content)
    model = onnx.load(artifact.path / record.file, load_external_data=False)
    bound = bind(model, places_of(path, values), piece, again=True)
    replace_file(path.with_suffix(".onnx"), bound)
    files = {name: one for name, one in manifest.files.items() if name not in (old, record.file)}
    files |= {each.name: describe(each) for each in (path, path.with_suffix(".onnx"))}
    pieces = {**manifest.pieces, piece: replace(record, file=path.with_suffix(".onnx").name)}
    if loop == ORIGINAL:
        return replace(manifest, files=files, pieces=pieces, stores=replace(manifest.stores, pruner=path.name))
    return replace(manifest, files=files, pieces=pieces, loop_pruners={**manifest.loop_pruners, loop: path.name})
