"""Weights of ONNX models as external data: references into the artifact's safetensors files, at any precision."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.coercion import Array, Arrays
from ..errors import ArtifactError
from ..ir.pieces import LAYERS
from . import tensors
from .files import write_synced
from .manifest import PieceRecord, PrecisionRecord
from .short import SHORT

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto, TensorProto

EMBEDDED_BYTES = 256
"""Tensors up to this size are stored in the model: onnxruntime's shape inference reads shapes and axes, and refuses to
do so from external data."""

LEAST_APART = 2**25
"""Bytes, in fp32, of what a copy of an artifact may leave out. Of Push-T they are 30 MB, too few for a file."""

_SHORT = "/short"
"""Ends the name of what is in 16 bits in a model; a Cast gives its numbers under the name without it."""

REPORT = "This is an error in ttscompile; please report it."


@dataclass(frozen=True)
class Place:
    """The value of a constant, a file in the model's folder, and where it lies in that."""

    value: Array
    file: str
    entry: tensors.Entry


@dataclass(frozen=True)
class LoweredPieces:
    """What ``lower_precision`` made of blocks and prologue.

    Attributes:
        models: by piece, those that hold all blocks among them.
        weights: the constants that these models have and the program has not.
    """

    name: str
    models: Mapping[str, ModelProto]
    weights: Arrays
    asked: tuple[str, ...] = ()


def places_of(path: Path, values: Arrays) -> dict[str, Place]:
    """Where these arrays lie in a safetensors file that holds them."""
    entries = tensors.entries_of(path)
    return {name: Place(value, path.name, entries[name]) for name, value in values.items()}


def bind(model: ModelProto, places: Mapping[str, Place], piece: str) -> bytes:
    """The bytes of a model whose empty initializers have their values, with a Cast behind those in 16 bits.

    Args:
        model: from ``lower``, or ``unbound``; initializers that are constants of the program hold no data.
        places: by name of the constant.

    Raises:
        ArtifactError: an empty initializer that is no constant of the program, or is one of another type.
    """
    bound = deepcopy(model)
    for graph in _graphs(bound.graph):
        empty = [tensor for tensor in graph.initializer if _is_empty(tensor)]
        for tensor in empty:
            if tensor.name not in places:
                problem = f"initializer {tensor.name!r} has no data and is no constant of the program"
                raise ArtifactError(f"ONNX model {piece!r}: {problem}. {REPORT}")
            _set(tensor, places[tensor.name], piece)
        if short := {tensor.name for tensor in empty if places[tensor.name].entry.code in SHORT}:
            _widen(graph, short)
    return bytes(bound.SerializeToString(deterministic=True))


def unbound(path: Path, names: Collection[str]) -> ModelProto:
    """A model that is bound, with these constants as ``lower`` gives them: in float32, and without data."""
    import onnx

    model = onnx.load(path, load_external_data=False)
    for graph in _graphs(model.graph):
        own = {tensor.name: tensor for tensor in graph.initializer if tensor.name.removesuffix(_SHORT) in names}
        for name, tensor in own.items():
            kind = onnx.TensorProto.FLOAT if name.endswith(_SHORT) else tensor.data_type
            tensor.CopyFrom(onnx.TensorProto(name=name.removesuffix(_SHORT), data_type=kind, dims=tensor.dims))
        for cast in [node for node in graph.node if node.name in own and node.name.endswith(_SHORT)]:
            graph.node.remove(cast)
    return model


def _widen(graph: GraphProto, short: set[str]) -> None:
    """Have a Cast to float32 behind each of these initializers, which are in 16 bits.

    onnxruntime computes it when the session is opened, and keeps float32 alone. Of a table, which is only gathered
    from, that would be all of it in memory: there the Cast is behind the Gather, and the table is left in its file.
    """
    from onnx import TensorProto
    from onnx.helper import make_node

    def cast(name: str) -> NodeProto:
        return make_node("Cast", [name + _SHORT], [name], name=name + _SHORT, to=TensorProto.FLOAT)

    whole = {value.name for value in graph.output}
    for inner in _graphs(graph):
        for node in inner.node:
            whole.update(node.input[1:] if inner is graph and node.op_type == "Gather" else node.input)
    nodes = [cast(name) for name in sorted(short & whole)]
    for tensor in graph.initializer:
        if tensor.name in short & whole:
            tensor.name += _SHORT
    for node in graph.node:
        nodes.append(node)
        if node.op_type == "Gather" and node.input[0] in short - whole:
            nodes.append(cast(node.output[0]))
            node.output[0] += _SHORT
    del graph.node[:]
    graph.node.extend(nodes)


def interface(model: ModelProto) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of a model's inputs, without those that are initialized, and of its outputs."""
    initialized = {tensor.name for tensor in model.graph.initializer}
    inputs = tuple(value.name for value in model.graph.input if value.name not in initialized)
    return inputs, tuple(value.name for value in model.graph.output)


def read_in_fp32(constants: Arrays, models: Mapping[str, ModelProto], lowered: LoweredPieces) -> dict[str, Array]:
    """Those of a program's constants that no call reads in which all parts have the other precision; few are none.

    The piece ``layers`` does not count, which is for ``verify``.
    """
    opened = {**{name: model for name, model in models.items() if name != LAYERS}, **lowered.models}
    read = {t.name for model in opened.values() for graph in _graphs(model.graph) for t in graph.initializer}
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
    if place.entry.length <= EMBEDDED_BYTES:
        tensor.data_location = TensorProto.DEFAULT
        tensor.raw_data = np.asarray(place.value, dtype=dtype.newbyteorder("<"), order="C").tobytes()
        return
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", place.file), ("offset", place.entry.offset), ("length", place.entry.length)):
        tensor.external_data.add(key=key, value=str(value))
    if place.entry.code in SHORT:
        tensor.data_type = TensorProto.BFLOAT16 if place.entry.code == "BF16" else TensorProto.FLOAT16


def _is_empty(tensor: TensorProto) -> bool:
    numbers = ("float_data", "int32_data", "int64_data", "double_data", "uint64_data", "string_data")
    return 0 not in tensor.dims and not any(len(getattr(tensor, n)) for n in ("raw_data", "external_data", *numbers))


def _graphs(graph: GraphProto) -> Iterator[GraphProto]:
    yield graph
    for attribute in (each for node in graph.node for each in node.attribute):
        for inner in (attribute.g, *attribute.graphs):
            yield from _graphs(inner)
