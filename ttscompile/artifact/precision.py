"""Write residual blocks of another precision beside those in fp32, which the reference runtime computes with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from ..artifact import tensors
from ..errors import ArtifactError
from .bind import Place, bind
from .files import write_synced
from .manifest import PieceRecord, PrecisionError, PrecisionRecord

if TYPE_CHECKING:
    from onnx import ModelProto


@dataclass(frozen=True)
class LoweredBlocks:
    """What ``lower_precision`` made of blocks.

    Attributes:
        name: of the precision.
        models: by block, and of the piece ``blocks`` if the artifact has it.
        weights: the constants that these models have and the program has not.
        error: as measured; None if it was not.
    """

    name: str
    models: Mapping[str, ModelProto]
    weights: Mapping[str, npt.NDArray[Any]]
    error: PrecisionError | None = None


def store_blocks(
    folder: Path, blocks: LoweredBlocks, pieces: Mapping[str, PieceRecord], places: Mapping[str, Place]
) -> PrecisionRecord:
    """Write models and weights of blocks into the folder of a new artifact.

    Args:
        folder: of the artifact.
        blocks: what to write.
        pieces: of the artifact.
        places: of the program's constants, which these models read too.

    Raises:
        ArtifactError: a model that does not fit its piece, or a constant that has the name of another.
    """
    file = f"weights_{blocks.name}.safetensors"
    if taken := sorted(set(blocks.weights) & set(places)):
        raise ArtifactError(
            f"precision {blocks.name!r}: expected constants of new names; found {taken[0]!r}, which the program has."
            " This is an error in ttscompile; please report it."
        )
    write_synced(folder / file, tensors.serialize(blocks.weights))
    offsets = tensors.offsets(folder / file)
    own = {name: Place(value, file, *offsets[name]) for name, value in blocks.weights.items()}
    files = {}
    for name, model in blocks.models.items():
        initialized = {tensor.name for tensor in model.graph.initializer}
        inputs = tuple(value.name for value in model.graph.input if value.name not in initialized)
        outputs = tuple(value.name for value in model.graph.output)
        piece = pieces.get(name)
        if piece is None or (inputs, outputs) != (piece.inputs, piece.outputs):
            raise ArtifactError(
                f"precision {blocks.name!r}: {name!r} reads {list(inputs)} and gives {list(outputs)}; expected"
                f" {'no such piece' if piece is None else (list(piece.inputs), list(piece.outputs))}. This is an error"
                " in ttscompile; please report it."
            )
        files[name] = f"{name}_{blocks.name}.onnx"
        bound = bind(model, {**places, **own}, name)
        write_synced(folder / files[name], bound.SerializeToString(deterministic=True))
    return PrecisionRecord(name=blocks.name, weights=file, models=files, error=blocks.error)
