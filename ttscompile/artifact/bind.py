"""Weights of ONNX models as external data: references into the artifact's safetensors files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import ArtifactError

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, TensorProto

EMBEDDED_BYTES = 256
"""Tensors up to this size are stored in the model: onnxruntime's shape inference reads shapes and axes, and refuses to
do so from external data."""


@dataclass(frozen=True)
class Place:
    """Where the value of a constant lies.

    Attributes:
        value: the array itself.
        file: name of the safetensors file, in the folder of the model.
        offset: of its first byte.
        length: in bytes.
    """

    value: npt.NDArray[Any]
    file: str
    offset: int
    length: int


def bind(model: ModelProto, places: Mapping[str, Place], piece: str) -> ModelProto:
    """A copy of a model whose empty initializers have their values.

    Args:
        model: from ``lower``; initializers that are constants of the program hold no data.
        places: by name of the constant.
        piece: name of the model, for messages.

    Raises:
        ArtifactError: an empty initializer that is no constant of the program, or is one of another type.
    """
    bound = _copy(model)
    for tensor in _initializers(bound.graph):
        if _is_empty(tensor):
            if tensor.name not in places:
                raise ArtifactError(
                    f"ONNX model {piece!r}: initializer {tensor.name!r} has no data and is no constant of the program."
                    " This is an error in ttscompile's lowering; please report it."
                )
            _set(tensor, places[tensor.name], piece)
    return bound


def rebind(model: ModelProto, places: Mapping[str, Place], piece: str) -> ModelProto:
    """A copy of a bound model in which the constants in ``places`` have new values.

    Raises:
        ArtifactError: a constant of another type.
    """
    bound = _copy(model)
    for tensor in _initializers(bound.graph):
        if tensor.name in places:
            _set(tensor, places[tensor.name], piece)
    return bound


def _set(tensor: TensorProto, place: Place, piece: str) -> None:
    from onnx import TensorProto
    from onnx.helper import tensor_dtype_to_np_dtype

    dtype, shape = np.dtype(tensor_dtype_to_np_dtype(tensor.data_type)), tuple(tensor.dims)
    if dtype != place.value.dtype or shape != place.value.shape:
        raise ArtifactError(
            f"ONNX model {piece!r}: initializer {tensor.name!r} is {dtype}{list(shape)}; the program's constant is"
            f" {place.value.dtype}{list(place.value.shape)}. This is an error in ttscompile; please report it."
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


def _copy(model: ModelProto) -> ModelProto:
    from onnx import ModelProto

    copy = ModelProto()
    copy.CopyFrom(model)
    return copy
