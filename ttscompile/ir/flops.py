"""FLOPs of a graph: multiply and add counted as two, contractions only (element-wise work is not counted)."""

from __future__ import annotations

from .graph import Graph, Node
from .operations import Types, operation


def node_flops(node: Node, types: Types) -> int:
    """FLOPs of one node for one stream."""
    count = operation(node.op).flops
    return 0 if count is None else count(node, types)


def graph_flops(graph: Graph) -> int:
    """FLOPs of one evaluation of the graph for one stream."""
    types = graph.types()
    return sum(node_flops(node, types) for node in graph.nodes)
