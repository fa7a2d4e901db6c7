"""Remove what does nothing: identities, examples of a type, dead code, repeated expressions, work on constants."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch

from ttscompile.core.coercion import Array
from ttscompile.ir.evaluate import evaluator
from ttscompile.ir.graph import Argument, Enum, Graph, Node, Ref, TensorType, backward_slice, copied
from ttscompile.ir.operations import Movement, operation
from ttscompile.ir.program import Phase, mapped

from .base import Pass, PassResult

AnyPhase = TypeVar("AnyPhase", bound=Phase)
Weights = dict[str, Array]

_CAST = "aten._to_copy.default"


class CleanUp(Pass[AnyPhase, AnyPhase]):
    """Simplify every graph of the program.

    Before::

        %clone = aten.clone.default(%x)
        %t     = aten.permute.default(%weight, [1, 0])
        %y     = aten.matmul.default(%clone, %t)

    After (``t`` is a new constant)::

        %y     = aten.matmul.default(%x, %t)

    Graph outputs keep their names, so pieces that are wired by name still fit together.
    """

    def call(self, program: AnyPhase) -> PassResult[AnyPhase]:
        weights = dict(program.weights)
        new = mapped(program, lambda graph: clean_graph(graph, weights))
        before, after = program.graphs(), new.graphs()
        used = {name for graph in after.values() for name in graph.constants}
        kept = {name: value for name, value in weights.items() if name in used}
        if after == before and kept.keys() == program.weights.keys():
            return PassResult(program)
        counts = [sum(len(graph.nodes) for graph in graphs.values()) for graphs in (before, after)]
        return PassResult(replace(new, weights=kept), (f"{counts[0]} nodes became {counts[1]}",))


def clean_graph(graph: Graph, weights: Weights) -> Graph:
    """One graph, simplified; constants that it folds are added to ``weights``."""
    return drop_dead(merge_repeated(fold_constants(drop_identities(forget_examples(graph)), weights)))


def forget_examples(graph: Graph) -> Graph:
    """Write what reads a value for its type only without that value: ``time.type_as(sample)``, ``ones_like(sample)``.

    Else all that follows would count as depending on the sample.
    """
    nodes = []
    for node in graph.nodes:
        kwargs: tuple[tuple[str, Argument], ...] = (("dtype", Enum("dtype", node.type.dtype)),)
        filled = operation(node.op).filled
        if node.op == "aten.type_as.default":
            node = replace(node, op=_CAST, args=node.args[:1], kwargs=kwargs)
        elif filled is not None and any(node.refs()) and not isinstance(value := filled(node), Ref):
            node = replace(node, op="aten.full.default", args=(node.type.shape, value), kwargs=kwargs)
        nodes.append(node)
    return replace(graph, nodes=tuple(nodes))


def drop_identities(graph: Graph) -> Graph:
    """Replace the uses of operations that return their first argument."""
    types = graph.types()
    return _without(graph, lambda node: next(node.refs()) if _is_identity(node, types) else None)


def _without(graph: Graph, same_as: Callable[[Node], str | None]) -> Graph:
    """The graph without the nodes for which there is another value: that is read in their place. Outputs stay."""
    same: dict[str, str] = {}
    nodes = []
    for node in graph.nodes:
        node = node.renamed(lambda name: same.get(name, name))
        other = same_as(node)
        if other is None or node.name in graph.outputs:
            nodes.append(node)
        else:
            same[node.name] = other
    return replace(graph, nodes=tuple(nodes))


def _is_identity(node: Node, types: dict[str, TensorType]) -> bool:
    """Whether it leaves all numbers where and what they are."""
    source = node.args[0] if node.args else None
    if not isinstance(source, Ref) or len(node.types) != 1 or types.get(source.name) != node.type:
        return False
    if node.op == "aten.add.Tensor":  # Python's sum([x, f]) begins with 0 + x
        return node.args[1:] == (0,) and not node.kwargs
    return node.op == _CAST or operation(node.op).movement not in (None, Movement.PERMUTE)


def fold_constants(graph: Graph, weights: Weights) -> Graph:
    """Evaluate what depends on nothing but constants, unless its shape depends on the batch."""
    types = graph.types()
    known = set(graph.constants)
    folded = []
    for node in graph.nodes:
        if known.issuperset(node.refs()) and not node.mentions_batch():
            folded.append(node)
            known.add(node.name)
    if not folded:
        return graph
    rest = [n for n in graph.nodes if n.name not in known]
    read = {name for n in rest for name in n.refs()} | set(graph.outputs)
    wanted = tuple(n.name for n in folded if n.name in read and len(n.types) == 1)
    fragment = drop_dead(Graph({}, graph.constants, tuple(folded), wanted))
    with torch.no_grad():
        values = evaluator(fragment, weights)({})
    constants = dict(graph.constants)
    for name, value in zip(wanted, values, strict=True):
        constants[name] = types[name]
        weights[name] = value.contiguous().numpy().copy()
    outputs = []
    for old in (n.name for n in folded if n.name in graph.outputs):  # it stays a node: pieces are wired by its name
        new = f"{old}.constant"
        constants[new] = constants.pop(old)
        weights[new] = weights[old]  # which another graph may read as a constant
        outputs.append(replace(copied(old, new, types[old]), source="constant output"))
    return replace(graph, constants=constants, nodes=(*outputs, *rest))


def merge_repeated(graph: Graph) -> Graph:
    """Compute equal expressions once."""
    seen: dict[tuple[object, ...], str] = {}

    def first(node: Node) -> str | None:
        # 1 == True == 1.0 in Python; their texts differ
        name = seen.setdefault((node.op, repr(node.args), repr(node.kwargs), node.types), node.name)
        return None if name == node.name else name

    return _without(graph, first)


def drop_dead(graph: Graph) -> Graph:
    """Drop nodes and constants that no output needs; inputs stay, they are the graph's signature."""
    return replace(backward_slice(graph, graph.outputs, {}), inputs=graph.inputs)
