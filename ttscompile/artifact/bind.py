"""Weights of ONNX models as external data: references into the artifact's safetensors files, at any precision."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import ArtifactError
from ..ir.pieces import LAYERS
from . import tensors
from .files import write_synced
from .manifest import PieceRecord, PrecisionRecord

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, TensorProto

EMBEDDED_BYTES = 256
"""Tensors up to this size are stored in the model: onnxruntime's shape inference reads shapes and axes, and refuses to
do so from external data."""

LEAST_APART = 2**25
"""Bytes that a copy of an artifact has to save by what it leaves out. Push-T would save 30 MB of 50."""

REPORT = "This is an error in ttscompile; please report it."


@dataclass(frozen=True)
class Place:
    """The value of a constant, and where it lies: file in the model's folder, first byte, and length in bytes."""

    value: npt.NDArray[Any]
    file: str
    offset: int
    length: int


@dataclass(frozen=True)
class LoweredPieces:
    """What ``lower_precision`` made of blocks and prologue.

    Attributes:
        models: by piece, those that hold all blocks among them.
        weights: the constants that these models have and the program has not.
    """

    name: str
    models: Mapping[str, ModelProto]
    weights: Mapping[str, npt.NDArray[Any]]
    asked: tuple[str, ...] = ()


def places_of(path: Path, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, Place]:
    """Where these arrays lie in a safetensors file that holds them."""
    offsets = tensors.offsets(path)
    return {name: Place(value, path.name, *offsets[name]) for name, value in values.items()}


def bind(model: ModelProto, places: Mapping[str, Place], piece: str, *, again: bool = False) -> bytes:
    """The bytes of a model whose empty initializers have their values.

    Args:
        model: from ``lower``; initializers that are constants of the program hold no data.
        places: by name of the constant.
        again: the model is bound already; the constants in ``places`` get new values.

    Raises:
        ArtifactError: an empty initializer that is no constant of the program, or is one of another type.
    """
    from onnx import ModelProto

    bound = ModelProto()
    bound.CopyFrom(model)
    for tensor in _initializers(bound.graph):
        if tensor.name in places and (again or _is_empty(tensor)):
            _set(tensor, places[tensor.name], piece)
        elif _is_empty(tensor):
            problem = f"initializer {tensor.name!r} has no data and is no constant of the program"
            raise ArtifactError(f"ONNX model {piece!r}: {problem}. {REPORT}")
    return bytes(bound.SerializeToString(deterministic=True))


def interface(model: ModelProto) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of a model's inputs, without those that are initialized, and of its outputs."""
    initialized = {tensor.name for tensor in model.graph.initializer}
    inputs = tuple(value.name for value in model.graph.input if value.name not in initialized)
    return inputs, tuple(value.name for value in model.graph.output)


def read_in_fp32(
    constants: Mapping[str, npt.NDArray[Any]], models: Mapping[str, ModelProto], lowered: LoweredPieces
) -> dict[str, npt.NDArray[Any]]:
    """Those of a program's constants that no call reads in which all parts have the other precision; few are none.

    The piece ``layers`` does not count, which is for ``verify``.
    """
    opened = {**{name: model for name, model in models.items() if name != LAYERS}, **lowered.models}
    read = {tensor.name for model in opened.values() for tensor in _initializers(model.graph)}
    apart = {name: value for name, value in constants.items() if name not in read}
    return apart if sum(value.nbytes for value in apart.values()) >= LEAST_APART else {}


def store_pieces(
    folder: Path, lowered: LoweredPieces, pieces: Mapping[str, PieceRecord], places: Mapping[str, Place]
) -> PrecisionRecord:
    """Write pieces beside those in fp32, which the reference runtime computes with, into the folder of a new artifact.

    ``places`` are of the program's constants, which these models read too.
    """
    where = f"precision {lowered.name!r}"
    if taken := sorted(set(lowered.weights) & set(places)):
        raise ArtifactError(f"{where}: expected constants of new names; found {taken[0]!r}. {REPORT}")
    file = f"weights_{lowered.name}.safetensors"
    tensors.write(folder / file, lowered.weights)
    places = {**places, **places_of(folder / file, lowered.weights)}
    files = {}
    for name, model in lowered.models.items():
        (inputs, outputs), piece = interface(model), pieces.get(name)
        if piece is None or (inputs, outputs) != (piece.inputs, piece.outputs):
            expected = "no such piece" if piece is None else (list(piece.inputs), list(piece.outputs))
            raise ArtifactError(
                f"{where}: {name!r} reads {list(inputs)} and gives {list(outputs)}; expected {expected}. {REPORT}"
            )
        files[name] = f"{name}_{lowered.name}.onnx"
        write_synced(folder / files[name], bind(model, places, name))
    return PrecisionRecord(lowered.name, file, files, lowered.asked)


def _set(tensor: TensorProto, place: Place, piece: str) -> None:
    from onnx import TensorProto
    from onnx.helper import tensor_dtype_to_np_dtype

    dtype, shape = np.dtype(tensor_dtype_to_np_dtype(tensor.data_type)), tuple(tensor.dims)
    if dtype != place.value.dtype or shape != place.value.shape:
        raise ArtifactError(
            f"ONNX model {piece!r}: initializer {tensor.name!r} is {dtype}{list(shape)}; the program's constant is"
            f" {place.value.dtype}{list(place.value.shape)}. {REPORT}"
        )
    for values in ("raw_data", "float_data", "int32_data", "int64_data", "double_data", "uint64_data", "external_data"):
        tensor.ClearField(values)
    if place.length <= EMBEDDED_BYTES:
        tensor.data_location = TensorProto.DEFAULT
        tensor.raw_data = np.asarray(place.value, dtype=dtype.newbyteorder("<"), order="C").tobytes()
        return
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", place.file), ("offset", place.offset), ("length", place.length)):
        tensor.external_data.add(key=key, value=str(value))


def _is_empty(tensor: TensorProto) -> bool:
    from onnx import TensorProto

    if tensor.data_location == TensorProto.EXTERNAL:
        return not tensor.external_data
    values = ("float_data", "int32_data", "int64_data", "double_data", "uint64_data", "string_data")
    has_data = bool(tensor.raw_data) or any(len(getattr(tensor, name)) for name in values)
    return not has_data and 0 not in tensor.dims


def _initializers(graph: GraphProto) -> Iterator[TensorProto]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            for inner in (attribute.g, *attribute.graphs):
                yield from _initializers(inner)
