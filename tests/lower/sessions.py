"""Run a lowered model with onnxruntime, its weights filled in."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import torch

from ttscompile.ir.graph import Graph
from ttscompile.lower.program import lower_graphs
from ttscompile.runtimes.onnxruntime.sessions import EXACT_INTEGERS

Array = npt.NDArray[Any]


def lower_graph(graph: Graph, name: str) -> onnx.ModelProto:
    """The ONNX model of one graph."""
    return lower_graphs({name: graph})[name]


def session(
    model: onnx.ModelProto, weights: Mapping[str, torch.Tensor] | Mapping[str, Array], exact: bool = True
) -> onnxruntime.InferenceSession:
    """A session on one thread of a model that is checked, unless it has operations of onnxruntime's or lacks shapes.

    Args:
        model: without the data of its weights.
        weights: every initializer without data must be among them.
        exact: integers are summed exactly on every processor.
    """
    filled = onnx.ModelProto()
    filled.CopyFrom(model)
    for tensor in _initializers(filled.graph):
        if not tensor.raw_data:
            given = weights[tensor.name]
            value = given.detach().numpy() if isinstance(given, torch.Tensor) else given
            expected = tuple(tensor.dims), onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type)
            assert expected == (value.shape, value.dtype)
            tensor.raw_data = np.ascontiguousarray(value).tobytes()
    own = {node.domain for node in filled.graph.node} <= {""}
    if own and all(value.type.tensor_type.HasField("shape") for value in filled.graph.output):
        onnx.checker.check_model(filled, full_check=True)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry(EXACT_INTEGERS, str(int(exact)))
    return onnxruntime.InferenceSession(filled.SerializeToString(), options, providers=["CPUExecutionProvider"])


def _initializers(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """Of the graph and of the branches in it."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield from _initializers(attribute.g)


def run(
    model: onnx.ModelProto, weights: Mapping[str, torch.Tensor], inputs: Mapping[str, torch.Tensor]
) -> list[npt.NDArray[np.generic]]:
    """The outputs, in order."""
    feeds = {name: value.detach().numpy() for name, value in inputs.items()}
    result: list[npt.NDArray[np.generic]] = session(model, weights).run(None, feeds)
    return result
