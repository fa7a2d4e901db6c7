"""Analyses of a graph: what depends on what, and through which values every path must go."""

from collections.abc import Container, Iterable

from .graph import Graph, Node, TensorType


def reachable_from(graph: Graph, sources: Iterable[str]) -> set[str]:
    """Names of the values that depend on any of ``sources``, themselves included."""
    reached = set(sources)
    for node in graph.nodes:
        if any(name in reached for name in node.refs()):
            reached.add(node.name)
    return reached


def reaching(graph: Graph, targets: Iterable[str]) -> set[str]:
    """Names of the values on which any of ``targets`` depends, themselves included."""
    reached = set(targets)
    for node in reversed(graph.nodes):
        if node.name in reached:
            reached.update(node.refs())
    return reached


def between(graph: Graph, start: str, stop: str) -> list[Node]:
    """Nodes on some path from ``start`` (excluded) to ``stop`` (included), in order."""
    forward, backward = reachable_from(graph, [start]), reaching(graph, [stop])
    return [n for n in graph.nodes if n.name in forward and n.name in backward and n.name != start]


def read_from_outside(graph: Graph, inside: Container[str]) -> dict[str, TensorType]:
    """Values that the nodes of these names read of others, and their types; without constants."""
    types, nodes = graph.types(), (node for node in graph.nodes if node.name in inside)
    read = (name for node in nodes for name in node.refs())
    return {name: types[name] for name in read if name not in inside and name not in graph.constants}


def dominators(graph: Graph, sources: Iterable[str], sinks: Iterable[str]) -> list[str]:
    """Values through which every path from ``sources`` to ``sinks`` goes, in order.

    With several sources or sinks the paths from all of them to all of them count, so a source is listed only when it
    is the only one, and likewise a sink.

    In a topological order a value is such a point exactly if no edge on a live path jumps over it.
    """
    sources, sinks = list(sources), list(sinks)
    live = reachable_from(graph, sources) & reaching(graph, sinks)
    starts, inner = [name for name in sources if name in live], [node for node in graph.nodes if node.name in live]
    position = {name: i for i, name in enumerate([*starts, *(node.name for node in inner)])}
    last_use = {name: position[node.name] for node in inner for name in node.refs()}
    last_use |= dict.fromkeys(sinks, len(position))  # an edge to a sink behind all of them
    points, horizon = [], -1
    for name, i in position.items():
        if horizon <= i and (i >= len(starts) or len(starts) == 1):
            points.append(name)
        horizon = max(horizon, last_use.get(name, -1))
    return points
