"""Give every attention an axis of heads: ONNX has none without."""

from __future__ import annotations

from dataclasses import replace

from ttscompile.ir.graph import Argument, Node, Ref, TensorType
from ttscompile.ir.program import Program

from .base import Pass, PassResult

_ATTENTION = "aten.scaled_dot_product_attention.default"


class WidenAttention(Pass):
    """Write attention of ``[B, T, C]`` as attention of one head.

    Before::

        %y = aten.scaled_dot_product_attention.default(%q, %k, %v)          # [B, T, C]

    After::

        %q.head = aten.unsqueeze.default(%q, 1)                             # [B, 1, T, C], %k and %v alike
        %y.head = aten.scaled_dot_product_attention.default(%q.head, %k.head, %v.head)
        %y      = aten.squeeze.dim(%y.head, 1)
    """

    def requires(self, program: Program) -> None:
        """The program has no block table yet."""
        if program.blocks:
            raise self.fail("runs before find_residual_blocks.")

    def call(self, program: Program) -> PassResult:
        """Rewrite in the denoiser."""
        graph = program.denoiser
        types = graph.types()
        flat = [n for n in graph.nodes if n.op == _ATTENTION and len(n.type.shape) == 3]
        if not flat:
            return PassResult(program, False)
        rewritten = {node.name: _widened(node, types) for node in flat}
        nodes = tuple(n for node in graph.nodes for n in rewritten.get(node.name, [node]))
        notes = (f"{len(flat)} attentions got an axis for their one head",)
        return PassResult(replace(program, denoiser=replace(graph, nodes=nodes)), True, notes)


def _widened(node: Node, types: dict[str, TensorType]) -> list[Node]:
    nodes: list[Node] = []

    def wide(argument: Argument) -> Argument:
        if not isinstance(argument, Ref) or len(types[argument.name].shape) != 3:
            return argument  # a mask of [T, S] fits as it is
        name, type_ = f"{argument.name}.head.{node.name}", _with_head(types[argument.name])
        if all(n.name != name for n in nodes):
            nodes.append(Node(name, "aten.unsqueeze.default", (argument, 1), (), (type_,), node.source))
        return Ref(name)

    args = tuple(wide(a) for a in node.args)
    kwargs = tuple((key, wide(a)) for key, a in node.kwargs)
    result = Node(f"{node.name}.head", node.op, args, kwargs, (_with_head(node.type),), node.source)
    return [*nodes, result, Node(node.name, "aten.squeeze.dim", (Ref(result.name), 1), (), node.types, node.source)]


def _with_head(type_: TensorType) -> TensorType:
    return replace(type_, shape=(type_.shape[0], 1, *type_.shape[1:]))
