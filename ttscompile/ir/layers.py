"""The layers inside a network that is one block: what ``verify`` looks at when it names the one that is broken."""

from dataclasses import replace

from .flops import node_flops
from .graph import Graph, Node
from .program import Program


def layers(program: Program) -> dict[str, str]:
    """Layers of the one block of a program: what reads weights or computes products, and no pass has changed.

    The name of a layer's result, the same in ``program.denoiser`` and in the graph of the block, by that of its
    weights, or of the result where it has none, in the order of execution. None of a program of several blocks.
    """
    if len(program.blocks) != 1:
        return {}
    block, original = program.pieces.blocks[0].graph, program.denoiser.producers()
    types, producers = block.types(), block.producers()
    found: dict[str, str] = {}
    for node in block.nodes:
        before = original.get(node.name)
        # Of several values, as a batch normalisation gives, none has the name of the node.
        if before is None or (before.op, before.types) != (node.op, (node.type,)) or node.name in block.outputs:
            continue
        name = _weights(block, producers, node) or (node.name if node_flops(node, types) > 0 else None)
        if name is not None:
            found[name if name not in {**found, **types} else f"{name}, {node.name}"] = node.name
    return found


def layers_graph(program: Program) -> Graph | None:
    """The graph of the one block with the results of its ``layers`` as outputs, called by the layers' names.

    None where there are no layers.
    """
    names = {result: layer for layer, result in layers(program).items()}
    if not names:
        return None
    return replace(program.pieces.blocks[0].graph.renamed(names), outputs=tuple(names.values()))


def _weights(graph: Graph, producers: dict[str, Node], node: Node) -> str | None:
    """Name of the first weights that a node reads, as they are or moved, without its last part; None if it has none."""
    for name in node.refs():
        while name in producers and len(refs := list(producers[name].refs())) == 1:
            (name,) = refs
        if name in graph.constants:
            return name.rpartition(".")[0] or name
    return None
