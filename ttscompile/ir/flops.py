"""FLOPs of a graph: multiply and add counted as two, contractions only (element-wise work is not counted)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from .graph import Graph, Node, Ref, TensorType


def _shape(types: Mapping[str, TensorType], argument: object) -> tuple[int, ...]:
    assert isinstance(argument, Ref)
    return types[argument.name].at(1)


def node_flops(node: Node, types: Mapping[str, TensorType]) -> int:
    """FLOPs of one node for one stream."""
    base = node.op.split(".")[1] if node.op.startswith("aten.") else node.op
    if base in ("linear", "mm", "matmul", "bmm"):
        contracted = _shape(types, node.args[0])[-1]
        return 2 * math.prod(node.type.at(1)) * contracted
    if base in ("addmm", "baddbmm"):
        return 2 * math.prod(node.type.at(1)) * _shape(types, node.args[1])[-1]
    if base == "scaled_dot_product_attention":
        query, key, value = (_shape(types, a) for a in node.args[:3])
        return 2 * math.prod(query[:-1]) * key[-2] * (query[-1] + value[-1])
    if base.startswith("conv") or base == "convolution":
        weight = _shape(types, node.args[1])
        # A transposed one spreads each input, where a plain one gathers each output.
        each = _shape(types, node.args[0]) if "transpose" in base else node.type.at(1)
        return 2 * math.prod(each) * math.prod(weight[1:])
    if base == "einsum":
        return _einsum_flops(node, types)
    if base in ("gru", "lstm"):  # every matrix of every layer meets each frame
        (parameters,) = node.args[2:3]
        assert isinstance(parameters, tuple)
        sizes = [math.prod(shape) for shape in (_shape(types, p) for p in parameters) if len(shape) == 2]
        return 2 * math.prod(_shape(types, node.args[0])[:-1]) * sum(sizes)
    return 0


def _einsum_flops(node: Node, types: Mapping[str, TensorType]) -> int:
    """The product of all sizes; axes under an ellipsis are called by their place from the right."""
    equation, operands = node.args[:2]
    assert isinstance(equation, str)
    assert isinstance(operands, tuple)
    sizes: dict[str | int, int] = {}
    for term, operand in zip(equation.replace(" ", "").split("->")[0].split(","), operands, strict=True):
        left, _, right = term.partition("...")
        shape = _shape(types, operand)
        names = (*left, *range(len(shape) - len(left) - len(right), 0, -1), *right)
        for name, size in zip(names, shape, strict=True):
            sizes[name] = max(size, sizes.get(name, 1))
    return 2 * math.prod(sizes.values())


def graph_flops(graph: Graph) -> int:
    """FLOPs of one evaluation of the graph for one stream."""
    types = graph.types()
    return sum(node_flops(node, types) for node in graph.nodes)
