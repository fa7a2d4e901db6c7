"""Weights that plans may have in place of the original's: written beside these, with models that refer to them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ..errors import ArtifactError
from ..ir.pieces import OF_ALL_BLOCKS, block_name
from . import tensors
from .bind import Place, bind, places_of
from .files import content_hash, describe, replace_file
from .load import Artifact
from .manifest import Manifest, WeightsRecord


@dataclass(frozen=True)
class BlockWeights:
    """Constants of residual blocks that a plan has in place of the original's.

    Attributes:
        weights: by name.
        precision: what the artifact's other precision makes of them, by name; empty where it has none.
    """

    weights: Mapping[str, npt.NDArray[Any]]
    precision: Mapping[str, npt.NDArray[Any]]


def without_weights(manifest: Manifest, kept: Collection[str]) -> Manifest:
    """The manifest with only these of its weights for blocks; files of the others are no longer listed."""
    gone = {file for name, record in manifest.weights.items() if name not in kept for file in record.files}
    return replace(
        manifest,
        files={name: record for name, record in manifest.files.items() if name not in gone},
        weights={name: record for name, record in manifest.weights.items() if name in kept},
    )


def store_weights(artifact: Artifact, manifest: Manifest, name: str, own: BlockWeights) -> Manifest:
    """Write weights into the artifact's directory, in files that nothing has yet; the manifest with their record.

    Raises:
        ArtifactError: a weight that is no constant of the artifact, or is one of another type.
        OSError: they cannot be written.
    """
    files = dict(manifest.files)
    if unknown := sorted(set(own.weights) - set(artifact.weights)):
        raise ArtifactError(f"weights {name!r}: expected constants of the artifact; found {unknown[0]!r}.")
    contents = [tensors.serialize(each) for each in (own.weights, own.precision)]
    prefix = f"blocks-{content_hash(b''.join(contents))}-"

    def write(file: str, content: bytes) -> Path:
        path = artifact.path / f"{prefix}{file}"
        replace_file(path, content)
        files[path.name] = describe(path)
        return path

    def again(models: Mapping[str, str], places: Mapping[str, Place], suffix: str = "") -> dict[str, str]:
        """The models of these files by piece, bound to the places; names of the new files."""
        import onnx

        bound = {}
        for piece, file in models.items():
            model = onnx.load(artifact.path / file, load_external_data=False)
            bound[piece] = write(f"{piece}{suffix}.onnx", bind(model, places, piece, again=True)).name
        return bound

    weights = write("weights.safetensors", contents[0])
    places = places_of(weights, own.weights)
    blocks = (*map(block_name, range(len(manifest.blocks))), *OF_ALL_BLOCKS)
    models = again({piece: manifest.pieces[piece].file for piece in blocks}, places)
    lower = {} if manifest.precision is None else manifest.precision.models
    lower = {piece: file for piece, file in lower.items() if piece in blocks}
    lower_file, lower_models = None, dict[str, str]()
    if lower:
        path = write("weights_lower.safetensors", contents[1])
        lower_file, places = path.name, places | places_of(path, own.precision)
        lower_models = again(lower, places, "_lower")
    record = WeightsRecord(weights.name, models, lower_file, lower_models)
    return replace(manifest, files=files, weights={**manifest.weights, name: record})
