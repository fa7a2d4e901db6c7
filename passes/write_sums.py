"""Write what adds in other words as an addition, so that the residual stream is found through it."""

from dataclasses import replace

from ttscompile.ir.dataflow import dominators, reachable_from
from ttscompile.ir.graph import Argument, Node, Ref
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_ADD, _MUL = "aten.add.Tensor", "aten.mul.Tensor"


class WriteSums(Pass[Captured, Captured]):
    """Scale first what is added with a factor, and then add it.

    Before (``x.addcmul(gate, branch)``; so are ``x - branch`` and ``torch.add(x, branch, alpha=0.5)``)::

        %y = aten.addcmul.default(%x, %gate, %branch)

    After::

        %y.added = aten.mul.Tensor(%gate, %branch)
        %y       = aten.add.Tensor(%x, %y.added)

    What is broadcast when it is added is no residual, and stays as it is. The result differs by rounding only.
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph, sample = program.denoiser, program.spec.sample_argument
        types, points = graph.types(), set(dominators(graph, [sample], graph.outputs))
        loop = reachable_from(graph, [sample])
        new: dict[str, list[Node]] = {}
        for node in graph.nodes:
            stream = node.args[0] if node.name in points and node.args else None
            # Elsewhere, in a rotary embedding say, the product would be an operation more for nothing.
            if not isinstance(stream, Ref) or stream.name not in points or types[stream.name] != node.type:
                continue
            added = [one.name for one in _added(node) if isinstance(one, Ref)]
            if loop.intersection(added) and node.type in [types[name] for name in added]:  # so the product has it, too
                new[node.name] = _written(node, stream)
        if not new:
            return PassResult(program)
        notes = tuple(f"%{name} is an addition" for name in new)
        return PassResult(replace(program, denoiser=graph.replaced(new)), notes)


def _added(node: Node) -> tuple[Argument, ...]:
    """The factors of what a node adds to its first argument, where it is no plain addition; none of other nodes."""
    options = dict(node.kwargs)
    if node.op == "aten.addcmul.default":
        return (*node.args[1:], options.get("value", 1))
    alpha = options.get("alpha", 1)
    if node.op == "aten.sub.Tensor":
        return (node.args[1], -alpha)  # type: ignore[operator]
    return (node.args[1], alpha) if node.op == _ADD and alpha != 1 else ()


def _written(node: Node, stream: Ref) -> list[Node]:
    product, *factors = (one for one in _added(node) if one != 1)
    nodes = []
    for i, factor in enumerate(factors):
        nodes.append(Node(f"{node.name}.added{i or ''}", _MUL, (product, factor), (), node.types, node.source))
        product = Ref(nodes[-1].name)
    return [*nodes, replace(node, op=_ADD, args=(stream, product), kwargs=())]
