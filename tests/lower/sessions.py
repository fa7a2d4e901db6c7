"""Run a lowered model with onnxruntime, its weights filled in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import torch


def session(model: onnx.ModelProto, weights: Mapping[str, torch.Tensor]) -> onnxruntime.InferenceSession:
    """A session on the model with these weights; every initializer without data must be among them."""
    filled = onnx.ModelProto()
    filled.CopyFrom(model)
    for tensor in _initializers(filled.graph):
        if not tensor.raw_data:
            value = weights[tensor.name]
            assert tuple(tensor.dims) == tuple(value.shape)
            tensor.raw_data = value.detach().numpy().tobytes()
    onnx.checker.check_model(filled, full_check=True)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
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
