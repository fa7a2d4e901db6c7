"""Files of an artifact that an update writes anew: the plans' arrays, weights of pruners, and those of blocks."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.coercion import Array, Arrays
from ..core.envelope import Envelope
from ..core.plan import ORIGINAL, Plan
from ..errors import ArtifactError
from ..ir.pieces import OF_ALL_BLOCKS, PRUNER, block_name, of_loop
from . import tensors
from .bind import Place, bind, places_of, unbound
from .corrections import correction_arrays, envelope_arrays, require_fit
from .files import content_hash, describe, replace_file
from .load import Artifact
from .manifest import FileRecord, Manifest, WeightsRecord


@dataclass(frozen=True)
class BlockWeights:
    """Constants of residual blocks that a plan has in place of the original's.

    Attributes:
        precision: what the artifact's other precision makes of them, by name; empty where it has none.
    """

    weights: Arrays
    precision: Arrays


def plan_arrays_of(manifest: Manifest, plans: Mapping[str, Plan], envelope: Envelope | None) -> dict[str, Array]:
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


def store_arrays(directory: Path, manifest: Manifest, store: str, arrays: Arrays) -> Manifest:
    """Write the file of a store beside the old one; without arrays there is none."""
    files = {name: record for name, record in manifest.files.items() if name != getattr(manifest.stores, store)}
    stores: dict[str, Any] = {store: None}
    if arrays:
        content = tensors.serialize(arrays)
        stores[store] = _put(directory, f"{store}-{content_hash(content)}.safetensors", content, files).name
    return replace(manifest, files=files, stores=replace(manifest.stores, **stores))


def pruner_name(piece: str, content: bytes) -> str:
    """Of the files of a loop's pruner. Those of two loops are never one: a calibration may change either."""
    return f"{PRUNER}-{content_hash(content if piece == PRUNER else content + piece.encode())}"


def store_pruner(artifact: Artifact, manifest: Manifest, weights: Arrays, loop: str) -> Manifest:
    """Write the weights of a loop's pruner, and its model that refers to them, beside the old ones."""
    piece = PRUNER if loop == ORIGINAL else of_loop(PRUNER, loop)
    record, old = manifest.pieces[piece], manifest.pruner_files[loop]
    values = {name: np.asarray(value) for name, value in weights.items()}
    expected = {name: (str(value.dtype), value.shape) for name, value in artifact.pruners[loop].items()}
    tensors.check_arrays("pruner's weight", values, expected, artifact.path, "Calibrate this artifact again.")
    files = {name: one for name, one in manifest.files.items() if name not in (old, record.file)}
    content = tensors.serialize(values)
    path = _put(artifact.path, f"{pruner_name(piece, content)}.safetensors", content, files)
    bound = bind(unbound(artifact.path / record.file, values), places_of(path, values), piece)
    model = _put(artifact.path, path.with_suffix(".onnx").name, bound, files)
    manifest = replace(manifest, files=files, pieces={**manifest.pieces, piece: replace(record, file=model.name)})
    if loop == ORIGINAL:
        return replace(manifest, stores=replace(manifest.stores, pruner=path.name))
    return replace(manifest, loop_pruners={**manifest.loop_pruners, loop: path.name})


def without_weights(manifest: Manifest, kept: Collection[str]) -> Manifest:
    """The manifest with only these of its weights for blocks; files of the others are no longer listed."""
    gone = {file for name, record in manifest.weights.items() if name not in kept for file in record.files}
    return replace(
        manifest,
        files={name: record for name, record in manifest.files.items() if name not in gone},
        weights={name: record for name, record in manifest.weights.items() if name in kept},
    )


def store_weights(artifact: Artifact, manifest: Manifest, name: str, own: BlockWeights) -> Manifest:
    """Write weights of blocks, in files that nothing has yet; the manifest with their record.

    Raises:
        ArtifactError: there are no such constants in the artifact.
        OSError: they cannot be written.
    """
    files = dict(manifest.files)
    if unknown := sorted(set(own.weights) - set(artifact.weights)):
        raise ArtifactError(f"weights {name!r}: expected constants of the artifact; found {unknown[0]!r}.")
    contents = [tensors.serialize(each) for each in (own.weights, own.precision)]
    prefix = f"blocks-{content_hash(b''.join(contents))}-"

    def again(models: Mapping[str, str], places: Mapping[str, Place], suffix: str = "") -> dict[str, str]:
        """The models of these files by piece, bound to the places; names of the new files."""
        made = dict[str, str]()
        for piece, file in models.items():
            model = bind(unbound(artifact.path / file, places), places, piece)
            made[piece] = _put(artifact.path, f"{prefix}{piece}{suffix}.onnx", model, files).name
        return made

    weights = _put(artifact.path, f"{prefix}weights.safetensors", contents[0], files)
    places = places_of(weights, own.weights)
    blocks = (*map(block_name, range(len(manifest.blocks))), *OF_ALL_BLOCKS)
    models = again({piece: manifest.pieces[piece].file for piece in blocks}, places)
    lower = {} if manifest.precision is None else manifest.precision.models
    lower = {piece: file for piece, file in lower.items() if piece in blocks}
    lower_file, lower_models = None, dict[str, str]()
    if lower:
        path = _put(artifact.path, f"{prefix}weights_lower.safetensors", contents[1], files)
        lower_file, places = path.name, places | places_of(path, own.precision)
        lower_models = again(lower, places, "_lower")
    record = WeightsRecord(weights.name, models, lower_file, lower_models)
    return replace(manifest, files=files, weights={**manifest.weights, name: record})


def _put(directory: Path, name: str, content: bytes, files: dict[str, FileRecord]) -> Path:
    path = directory / name
    replace_file(path, content)
    files[name] = describe(path)
    return path
