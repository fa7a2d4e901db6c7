"""Weights of the plan ``distilled``: written beside those of the original, with models that refer to them."""

from __future__ import annotations

from collections.abc import Mapping
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
from .manifest import DistilledRecord, Manifest


@dataclass(frozen=True)
class DistilledWeights:
    """Constants of residual blocks that the plan ``distilled`` has in place of the original's.

    Attributes:
        weights: by name.
        precision: what the artifact's other precision makes of them, by name; empty where it has none.
    """

    weights: Mapping[str, npt.NDArray[Any]]
    precision: Mapping[str, npt.NDArray[Any]]


def store_distilled(artifact: Artifact, manifest: Manifest, distilled: DistilledWeights | None) -> Manifest:
    """Write these weights into the artifact's directory, under names that nothing has yet.

    Args:
        artifact: as it is.
        manifest: as it will be, but for these weights.
        distilled: None for none; those of before are no longer listed then.

    Returns:
        The manifest with their record.

    Raises:
        ArtifactError: a weight that is no constant of the artifact, or is one of another type.
        OSError: they cannot be written.
    """
    old = set() if manifest.distilled is None else manifest.distilled.files
    files = {name: record for name, record in manifest.files.items() if name not in old}
    if distilled is None:
        return replace(manifest, files=files, distilled=None)
    if unknown := sorted(set(distilled.weights) - set(artifact.weights)):
        raise ArtifactError(f"distilled weights: expected constants of the artifact; found {unknown[0]!r}.")
    contents = [tensors.serialize(each) for each in (distilled.weights, distilled.precision)]
    prefix = f"distilled-{content_hash(b''.join(contents))}-"

    def write(name: str, content: bytes) -> Path:
        path = artifact.path / f"{prefix}{name}"
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
    places = places_of(weights, distilled.weights)
    blocks = (*map(block_name, range(len(manifest.blocks))), *OF_ALL_BLOCKS)
    models = again({name: manifest.pieces[name].file for name in blocks}, places)
    lower = {} if manifest.precision is None else manifest.precision.models
    lower = {name: file for name, file in lower.items() if name in blocks}
    own, names = None, dict[str, str]()
    if lower:
        path = write("weights_lower.safetensors", contents[1])
        own, places = path.name, places | places_of(path, distilled.precision)
        names = again(lower, places, "_lower")
    return replace(manifest, files=files, distilled=DistilledRecord(weights.name, models, own, names))
