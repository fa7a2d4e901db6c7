"""Regroup sums of several branches, so that what is added to the residual stream is one value."""

from dataclasses import replace

from ttscompile.ir.dataflow import dominators, reachable_from, reaching
from ttscompile.ir.graph import Graph, Node, Ref
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_ADD = "aten.add.Tensor"


class RegroupSums(Pass[Captured, Captured]):
    """Add the branches of parallel blocks to each other first, and then to the residual stream.

    Before (``x + attention(n) + feed_forward(n)``, as Python reads it)::

        %s = aten.add.Tensor(%x, %attention)          # no residual: another path goes around it
        %y = aten.add.Tensor(%s, %feed_forward)

    After::

        %y.branches = aten.add.Tensor(%attention, %feed_forward)
        %y          = aten.add.Tensor(%x, %y.branches)

    The result differs from the original by rounding only. Sums in which all terms but the residual stream depend on the
    sample are regrouped; a term that does not (a position, say) is no residual, and stays where it is.
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph, sample = program.denoiser, program.spec.sample_argument
        producers, types, users = graph.producers(), graph.types(), graph.users()
        points = set(dominators(graph, [sample], graph.outputs))
        loop = reachable_from(graph, [sample])
        new: dict[str, list[Node]] = {}
        notes = []
        for node in graph.nodes:
            if node.name not in points or not _plain(node):
                continue
            terms = _terms(graph, node, producers, users, points)
            streams = [t for t in terms if t in points and types[t] == node.type]
            branches = [t for t in terms if t not in streams]
            if len(streams) != 1 or len(branches) < 2 or any(t not in loop or types[t] != node.type for t in branches):
                continue
            new[node.name] = _regrouped(node, streams[0], branches)
            notes.append(f"%{node.name} ({node.place}): {len(branches)} branches in parallel")
        if not new:
            return PassResult(program)
        regrouped = graph.replaced(new)
        live = reaching(regrouped, graph.outputs)  # without the sums that were inside
        regrouped = replace(regrouped, nodes=tuple(n for n in regrouped.nodes if n.name in live))
        return PassResult(replace(program, denoiser=regrouped), tuple(notes))


def _plain(node: Node) -> bool:
    return node.op == _ADD and not node.kwargs and sum(isinstance(a, Ref) for a in node.args) == 2


def _terms(
    graph: Graph, node: Node, producers: dict[str, Node], users: dict[str, list[Node]], points: set[str]
) -> list[str]:
    """What a sum adds up, through the sums that nothing else reads and that not everything goes through."""
    terms = []
    for name in node.refs():
        inner = producers.get(name)
        nested = inner is not None and _plain(inner) and inner.type == node.type and name not in points
        if nested and inner is not None and len(users[name]) == 1 and name not in graph.outputs:
            terms += _terms(graph, inner, producers, users, points)
        else:
            terms.append(name)
    return terms


def _regrouped(node: Node, stream: str, branches: list[str]) -> list[Node]:
    nodes: list[Node] = []
    total = branches[0]
    for i, branch in enumerate(branches[1:]):
        name = f"{node.name}.branches{i or ''}"
        nodes.append(Node(name, _ADD, (Ref(total), Ref(branch)), (), node.types, node.source))
        total = name
    return [*nodes, replace(node, args=(Ref(stream), Ref(total)))]
