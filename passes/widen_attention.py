"""Give every attention an axis of heads, and every mask a row for each query: ONNX has none without."""

from dataclasses import replace

from ttscompile.ir.graph import Argument, Node, Ref, TensorType
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_ATTENTION = "aten.scaled_dot_product_attention.default"
_MASK = 3


class WidenAttention(Pass[Captured, Captured]):
    """Write attention of ``[B, T, C]`` as attention of one head, and masks without rows with the same row repeated.

    Before::

        %y = aten.scaled_dot_product_attention.default(%q, %k, %v)          # [B, T, C]
        %z = aten.scaled_dot_product_attention.default(%r, %l, %w, %pad)    # %pad : [B, 1, 1, S]

    After::

        %q.head = aten.unsqueeze.default(%q, 1)                             # [B, 1, T, C], %k and %v alike
        %y.head = aten.scaled_dot_product_attention.default(%q.head, %k.head, %v.head)
        %y      = aten.squeeze.dim(%y.head, 1)
        %z.mask = aten.expand.default(%pad, [B, 1, T, S])
        %z      = aten.scaled_dot_product_attention.default(%r, %l, %w, %z.mask)
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph = program.denoiser
        types = graph.types()
        nodes: list[Node] = []
        masks: dict[object, Argument] = {}
        widened = 0
        for node in graph.nodes:
            parts = [node]
            if node.op == _ATTENTION and len(node.type.shape) == 3:
                parts, widened = _widened(node, types), widened + 1
                types |= {part.name: part.type for part in parts}
            for part in parts:
                nodes += _with_rows(part, types, masks) if part.op == _ATTENTION else [part]
        if not widened and not masks:
            return PassResult(program)
        notes = (f"{widened} attentions got an axis for their one head, {len(masks)} masks a row for each query",)
        return PassResult(replace(program, denoiser=replace(graph, nodes=tuple(nodes))), notes)


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


def _with_rows(node: Node, types: dict[str, TensorType], made: dict[object, Argument]) -> list[Node]:
    """The attention on a mask of ``[.., T, S]``, and the nodes that make that; ``made`` has those of others."""
    mask = node.argument(_MASK, dict(node.kwargs).get("attn_mask"))
    if not isinstance(mask, Ref):
        return [node]
    query, key = node.args[:2]
    assert isinstance(query, Ref) and isinstance(key, Ref)
    tokens, type_ = (types[query.name].shape[-2], types[key.name].shape[-2]), types[mask.name]
    if type_.shape[-2:] == tokens and len(type_.shape) != 3:
        return [node]
    nodes: list[Node] = []
    same = (mask, tokens, len(node.type.shape))
    if same not in made:
        while len(type_.shape) < len(node.type.shape):  # torch aligns to the right, ONNX takes the first of three for B
            type_ = replace(type_, shape=(1, *type_.shape))
            nodes.append(Node(f"{node.name}.mask{len(nodes)}", "aten.unsqueeze.default", (mask, 0), (), (type_,)))
            mask = Ref(nodes[-1].name)
        type_ = replace(type_, shape=(*type_.shape[:-2], *tokens))
        nodes.append(Node(f"{node.name}.mask", "aten.expand.default", (mask, type_.shape), (), (type_,), node.source))
        made[same] = Ref(nodes[-1].name)
    args = tuple(made[same] if i == _MASK else a for i, a in enumerate(node.args))
    kwargs = tuple((name, made[same] if name == "attn_mask" else a) for name, a in node.kwargs)
    return [*nodes, replace(node, args=args, kwargs=kwargs)]
