"""FLOPs of a graph: multiply and add counted as two, contractions only (element-wise work is not counted)."""

from .graph import Graph, Node
from .operations import Types, operation
from .program import Pieces


def node_flops(node: Node, types: Types) -> int:
    """FLOPs of one node for one stream."""
    count = operation(node.op).flops
    return 0 if count is None else count(node, types)


def once_flops(pieces: Pieces) -> int:
    """FLOPs of one stream of what the observation alone decides, step values left out."""
    scene = 0 if pieces.scene is None else graph_flops(pieces.scene)
    return frames_flops(pieces) + scene + graph_flops(pieces.condition)


def frames_flops(pieces: Pieces) -> int:
    """FLOPs of what is computed once a frame, for all frames of a call of one stream."""
    before = 0 if pieces.frames is None else graph_flops(pieces.frames)
    return before + sum(n * graph_flops(tower) for n, tower in zip(pieces.rows, pieces.towers, strict=True))


def graph_flops(graph: Graph) -> int:
    """FLOPs of one evaluation of the graph for one stream."""
    types = graph.types()
    return sum(node_flops(node, types) for node in graph.nodes)
