"""Write ONNX graphs node by node: values get fresh names, and whole models can be laid inside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, ValueInfoProto, helper, numpy_helper

from ..core.coercion import Array, Arrays
from ..errors import LoweringError


class GraphWriter:
    """Nodes and constants of one graph; ``inner`` opens a graph for the body of an If, a Loop or a Scan.

    Names are unique over all graphs of a model, since a body sees the values of the graphs around it.
    """

    def __init__(self, names: Iterator[int] | None = None) -> None:
        self._names = count() if names is None else names
        self.nodes: list[NodeProto] = []
        self.initializers: list[TensorProto] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def inner(self) -> GraphWriter:
        """A writer for a body."""
        return GraphWriter(self._names)

    def fresh(self, hint: str) -> str:
        """A name that no value has."""
        return f"{hint}.{next(self._names)}"

    def constant(self, value: npt.ArrayLike, dtype: npt.DTypeLike = np.int64) -> str:
        """A constant; equal ones of a graph are one."""
        array = np.asarray(value, dtype=dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = name = self.fresh("constant")
            self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name))
        return self._constants[key]

    def default(self, name: str, value: Array, shape: Sequence[int | str] | None = None) -> ValueInfoProto:
        """An input of the model, and what it is if it is not given; of the value's shape if no other is said."""
        self.initializers.append(numpy_helper.from_array(value, name))
        return tensor(name, value.dtype, value.shape if shape is None else shape)

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """A node of one output; its name."""
        return self.ops(kind, inputs, 1, **attributes)[0]

    def ops(self, kind: str, inputs: Sequence[str], outputs: int | Sequence[str], **attributes: Any) -> list[str]:
        """A node; the names of its outputs, which may be given."""
        made = [self.fresh(kind) for _ in range(outputs)] if isinstance(outputs, int) else list(outputs)
        self.nodes.append(helper.make_node(kind, list(inputs), made, name=self.fresh("node"), **attributes))
        return made

    def rename(self, value: str, name: str) -> str:
        """The value under a name of our choice, for an output of the model."""
        return self.ops("Identity", [value], [name])[0]

    def choose(self, condition: str, then: GraphProto, otherwise: GraphProto) -> list[str]:
        """An If; the names of its outputs."""
        return self.ops("If", [condition], len(then.output), then_branch=then, else_branch=otherwise)

    def inline(self, model: ModelProto, inputs: Mapping[str, str], weights: Arrays) -> list[str]:
        """Lay a model inside this graph, its weights too: onnxruntime packs only weights of the graph that reads them.

        ``inputs`` has a value for each of its inputs, and for constants that are no weights here. The outputs' names.
        """
        graph = model.graph
        names = dict(inputs)
        for tensor in graph.initializer:
            if tensor.name not in inputs:
                names[tensor.name] = self._weight(tensor, weights)
        for node in graph.node:
            for output in node.output:
                names[output] = self.fresh("value") if output else ""
            copy = NodeProto()
            copy.CopyFrom(node)
            copy.name = self.fresh("node")
            copy.input[:] = [names[value] if value else "" for value in node.input]
            copy.output[:] = [names[value] for value in node.output]
            self.nodes.append(copy)
        return [names[value.name] for value in graph.output]

    def _weight(self, tensor: TensorProto, weights: Arrays) -> str:
        if tensor.raw_data or 0 in tensor.dims:
            made = numpy_helper.to_array(tensor)
            return self.constant(made, made.dtype)
        value, shape = weights.get(tensor.name), tuple(tensor.dims)
        if value is None or value.shape != shape:
            what = f"the model's initializer {tensor.name!r} {list(shape)} has no value among the program's weights"
            raise LoweringError(f"{what}. This is an error in ttscompile; please report it.")
        name = self.fresh(tensor.name)
        self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def body(self, name: str, *results: str) -> GraphProto:
        """What was written, as a branch of an If whose outputs are float32."""
        return self.graph(name, [tensor(result, np.float32) for result in results])

    def graph(self, name: str, outputs: Sequence[ValueInfoProto], inputs: Sequence[ValueInfoProto] = ()) -> GraphProto:
        """What was written, as a graph."""
        return helper.make_graph(self.nodes, name, list(inputs), list(outputs), self.initializers)


def tensor(name: str, dtype: npt.DTypeLike, shape: Sequence[int | str] | None = None) -> ValueInfoProto:
    """A value's name and type; shape None where it may be anything."""
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), shape)


def sequence(name: str, dtype: npt.DTypeLike = np.float32) -> ValueInfoProto:
    """A sequence of tensors."""
    return helper.make_tensor_sequence_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), None)
