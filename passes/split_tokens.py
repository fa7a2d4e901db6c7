"""Split a concatenation of tokens with different binding times, as far down as the work on it is token-wise."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from ttscompile.ir.binding import bindings, input_bindings, join
from ttscompile.ir.graph import GETITEM, Argument, Batch, Graph, Node, Ref, Size, TensorType
from ttscompile.ir.program import Binding, Cut

from .base import Pass, PassResult

_UNARY = frozenset(
    "gelu relu silu mish tanh sigmoid softplus exp sin cos neg rsqrt sqrt abs erf elu leaky_relu hardswish hardtanh"
    " clamp clone pow reciprocal _to_copy to contiguous dropout square log1p expm1".split()
)
_BINARY = frozenset("add sub mul div".split())


@dataclass(frozen=True)
class _Parts:
    """A value known as a concatenation along ``axis`` of ``names``, whose sizes there are ``sizes``."""

    axis: int
    names: tuple[str, ...]
    sizes: tuple[int, ...]


class SplitTokens(Pass[Cut, Cut]):
    """Let each token of a condition sequence be encoded at its own binding time.

    Before::

        %tokens = aten.cat.default([%time, %observation], 1)     # step
        %k      = aten.linear.default(%tokens, %w, %b)           # step: all of it, for every step

    After::

        %k.part0 = aten.linear.default(%time, %w, %b)            # a table in the artifact
        %k.part1 = aten.linear.default(%observation, %w, %b)     # once a call
        %k       = aten.cat.default([%k.part0, %k.part1], 1)     # sunk into the blocks by hoist

    Attention and everything else that mixes tokens is not split: there the concatenation is made.
    """

    def call(self, program: Cut) -> PassResult[Cut]:
        """Split in the prologue."""
        splitter = _Splitter(program.prologue, input_bindings(program.spec))
        rewritten = splitter.run()
        new = replace(program, prologue=rewritten) if splitter.split_at else program
        return PassResult(new, tuple(splitter.notes))


class _Splitter:
    """One sweep over a graph; ``parts`` holds the values that are known in parts."""

    def __init__(self, graph: Graph, inputs: Mapping[str, Binding]) -> None:
        self.graph = graph
        self.types = graph.types()
        self.bindings = bindings(graph, inputs)
        self.parts: dict[str, _Parts] = {}
        self.whole: set[str] = set()
        self.nodes: list[Node] = []
        self.notes: list[str] = []
        self.split_at: list[str] = []

    def run(self) -> Graph:
        for node in self.graph.nodes:
            self._visit(node)
        for name in self.graph.outputs:
            self._need(name)
        for name in self.split_at:
            self.notes.append(f"split %{name} into {len(self.parts[name].names)} groups of tokens")
        if self.split_at:
            self.notes.append(f"{len(self.parts) - len(self.split_at)} token-wise operations follow the split")
        return replace(self.graph, nodes=tuple(self.nodes))

    def _visit(self, node: Node) -> None:
        if node.op == "aten.cat.default" and self._split_cat(node):
            return
        operands = [name for name in dict.fromkeys(node.refs()) if name in self.parts]
        if operands:
            rule = _RULES.get(_base(node))
            parts = rule(self, node) if rule is not None else None
            if parts is not None:
                self.parts[node.name] = parts
                return
            for name in operands:
                if name not in self.whole and self.bindings[name] is Binding.STEP:
                    self.notes.append(
                        f"declined to split further at %{node.name} = {node.op} ({node.source or 'source unknown'}):"
                        " it is not token-wise, or no rule knows it"
                    )
                self._need(name)
        self.nodes.append(node)

    def _need(self, name: str) -> None:
        """Make a split value whole, under its own name."""
        parts = self.parts.get(name)
        if parts is None or name in self.whole:
            return
        self.whole.add(name)
        refs: tuple[Argument, ...] = tuple(Ref(p) for p in parts.names)
        self.nodes.append(
            Node(name, "aten.cat.default", (refs, parts.axis), (), (self.types[name],), "sunk by SplitTokens")
        )

    def emit(self, node: Node, index: int, args: tuple[Argument, ...], types: tuple[TensorType, ...]) -> str:
        """Add the ``index``-th part of ``node`` and return its name."""
        name = f"{node.name}.part{index}"
        part = replace(node, name=name, args=args, types=types)
        self.nodes.append(part)
        self.types[name] = types[0]
        read = [self.bindings[n] for n in part.refs()]
        binding = Binding.CONSTANT
        for other in read:
            binding = join(binding, other)
        self.bindings[name] = binding
        return name

    def _split_cat(self, node: Node) -> bool:
        if self.bindings[node.name] is not Binding.STEP:
            return False  # all of it leaves the loop as it is
        operands = node.args[0]
        assert isinstance(operands, tuple)
        names = [o.name for o in operands if isinstance(o, Ref)]
        if any(self.types[name].dtype != node.type.dtype for name in names):
            return False  # apart, what is another dtype in the whole would be computed with in its own
        axis = _positive(node.args[1] if len(node.args) > 1 else 0, node.type)
        pieces: list[tuple[str, int]] = []
        for name in names:
            inner = self.parts.get(name)
            if inner is not None and inner.axis == axis:
                pieces += zip(inner.names, inner.sizes, strict=True)
            elif inner is None and isinstance(size := self.types[name].shape[axis], int):
                pieces.append((name, size))
            else:
                return False
        groups: list[list[tuple[str, int]]] = []
        for piece in pieces:
            if groups and self.bindings[groups[-1][0][0]] is self.bindings[piece[0]]:
                groups[-1].append(piece)
            else:
                groups.append([piece])
        if len(groups) < 2:
            return False
        grouped: list[str] = []
        for i, group in enumerate(groups):
            if len(group) == 1:
                grouped.append(group[0][0])
                continue
            size = sum(s for _, s in group)
            refs: tuple[Argument, ...] = tuple(Ref(n) for n, _ in group)
            grouped.append(self.emit(node, i, (refs, axis), (_resized(node.type, axis, size),)))
        self.parts[node.name] = _Parts(axis, tuple(grouped), tuple(sum(s for _, s in g) for g in groups))
        self.split_at.append(node.name)
        return True

    def slice_part(self, node: Node, name: str, axis: int, start: int, size: int, index: int) -> str:
        """Rows ``start .. start + size`` of an operand that is not split."""
        type_ = _resized(self.types[name], axis, size)
        part = f"{node.name}.slice{index}"
        self.nodes.append(
            Node(part, "aten.slice.Tensor", (Ref(name), axis, start, start + size), (), (type_,), node.source)
        )
        self.types[part], self.bindings[part] = type_, self.bindings[name]
        return part


def _base(node: Node) -> str:
    return node.op if node.op == GETITEM else node.op.split(".")[1]


def _positive(axis: Argument, type_: TensorType) -> int:
    assert isinstance(axis, int)
    return axis % len(type_.shape)


def _resized(type_: TensorType, axis: int, size: int) -> TensorType:
    shape = list(type_.shape)
    shape[axis] = size
    return TensorType(tuple(shape), type_.dtype)


def _first(node: Node) -> str | None:
    return node.args[0].name if node.args and isinstance(node.args[0], Ref) else None


def _per_part(
    splitter: _Splitter, node: Node, source: _Parts, axis: int, args: Callable[[Ref, int], tuple[Argument, ...]]
) -> _Parts:
    """Emit ``node`` once a part; ``args`` gives its arguments for a part and that part's size."""
    names = tuple(
        splitter.emit(node, i, args(Ref(name), size), tuple(_resized(t, axis, size) for t in node.types))
        for i, (name, size) in enumerate(zip(source.names, source.sizes, strict=True))
    )
    return _Parts(axis, names, source.sizes)


def _only_first_is_split(splitter: _Splitter, node: Node) -> _Parts | None:
    name = _first(node)
    split = [n for n in node.refs() if n in splitter.parts]
    return splitter.parts[name] if name is not None and split == [name] else None


def _unary(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    if source is None or len(list(node.refs())) != 1:
        return None
    return _per_part(splitter, node, source, source.axis, lambda part, _: (part, *node.args[1:]))


def _binary(splitter: _Splitter, node: Node) -> _Parts | None:
    rank = len(node.type.shape)
    aligned: dict[str, _Parts] = {}
    for name in node.refs():
        if name in splitter.parts:
            parts = splitter.parts[name]
            shift = rank - len(splitter.types[name].shape)
            aligned[name] = replace(parts, axis=parts.axis + shift)
    axes = {(p.axis, p.sizes) for p in aligned.values()}
    if len(axes) != 1:
        return None
    axis, sizes = next(iter(axes))
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    names = []
    for i, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        args: list[Argument] = []
        for position, argument in enumerate(node.args):
            if not isinstance(argument, Ref):
                args.append(argument)
            elif argument.name in aligned:
                args.append(Ref(aligned[argument.name].names[i]))
            else:
                shape = splitter.types[argument.name].shape
                own = axis - (rank - len(shape))
                if own < 0 or shape[own] == 1:
                    args.append(argument)
                else:
                    index = i * len(node.args) + position
                    args.append(Ref(splitter.slice_part(node, argument.name, own, start, size, index)))
        names.append(splitter.emit(node, i, tuple(args), (_resized(node.type, axis, size),)))
    return _Parts(axis, tuple(names), sizes)


def _linear(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    if source is None or source.axis == len(node.type.shape) - 1:
        return None
    return _per_part(splitter, node, source, source.axis, lambda part, _: (part, *node.args[1:]))


def _matmul(splitter: _Splitter, node: Node) -> _Parts | None:
    name, other = _first(node), node.args[1]
    if name is None or not isinstance(other, Ref) or len(splitter.types[other.name].shape) != 2:
        return None  # a batched right side may belong to the tokens, as in attention
    return _linear(splitter, node)


def _layer_norm(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    normalized = node.args[1]
    if source is None or not isinstance(normalized, tuple):
        return None
    if source.axis >= len(node.type.shape) - len(normalized):
        return None
    return _per_part(splitter, node, source, source.axis, lambda part, _: (part, *node.args[1:]))


def _transpose(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    if source is None:
        return None
    first, second = (_positive(a, node.type) for a in node.args[1:3])
    axis = {first: second, second: first}.get(source.axis, source.axis)
    return _per_part(splitter, node, source, axis, lambda part, _: (part, *node.args[1:]))


def _permute(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    if source is None or not isinstance(node.args[1], tuple):
        return None
    order = [_positive(a, node.type) for a in node.args[1]]
    return _per_part(splitter, node, source, order.index(source.axis), lambda part, _: (part, *node.args[1:]))


def _unsqueeze(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    if source is None:
        return None
    new = _positive(node.args[1], node.type)
    axis = source.axis + (new <= source.axis)
    return _per_part(splitter, node, source, axis, lambda part, _: (part, *node.args[1:]))


def _squeeze(splitter: _Splitter, node: Node) -> _Parts | None:
    source, name = _only_first_is_split(splitter, node), _first(node)
    if source is None or name is None or len(node.args) < 2 or not isinstance(node.args[1], int):
        return None
    type_ = splitter.types[name]
    gone = _positive(node.args[1], type_)
    if gone == source.axis or type_.shape[gone] != 1:
        return None
    axis = source.axis - (gone < source.axis)
    return _per_part(splitter, node, source, axis, lambda part, _: (part, *node.args[1:]))


def _select(splitter: _Splitter, node: Node) -> _Parts | None:
    source, name = _only_first_is_split(splitter, node), _first(node)
    if source is None or name is None:
        return None
    gone = _positive(node.args[1], splitter.types[name])
    if gone == source.axis:
        return None
    axis = source.axis - (gone < source.axis)
    return _per_part(splitter, node, source, axis, lambda part, _: (part, *node.args[1:]))


def _along_other_axis(default: int) -> Callable[[_Splitter, Node], _Parts | None]:
    """slice, chunk, split and softmax act on one axis; the others pass through. ``default`` is its position in args."""

    def rule(splitter: _Splitter, node: Node) -> _Parts | None:
        source, name = _only_first_is_split(splitter, node), _first(node)
        if source is None or name is None:
            return None
        argument = node.args[default] if len(node.args) > default else dict(node.kwargs).get("dim", 0)
        if _positive(argument, splitter.types[name]) == source.axis:
            return None
        return _per_part(splitter, node, source, source.axis, lambda part, _: (part, *node.args[1:]))

    return rule


def _getitem(splitter: _Splitter, node: Node) -> _Parts | None:
    source = _only_first_is_split(splitter, node)
    return (
        None
        if source is None
        else _per_part(splitter, node, source, source.axis, lambda part, _: (part, *node.args[1:]))
    )


def _product(shape: Sequence[Size]) -> tuple[int, int]:
    """Numbers and batches in a product of sizes."""
    numbers = math.prod(n.multiple if isinstance(n, Batch) else n for n in shape)
    return numbers, sum(isinstance(n, Batch) for n in shape)


def _view(splitter: _Splitter, node: Node) -> _Parts | None:
    """A view keeps the split if the token axis survives: the sizes before it, and itself, have the same product."""
    source, name = _only_first_is_split(splitter, node), _first(node)
    if source is None or name is None:
        return None
    shape, new = splitter.types[name].shape, node.type.shape
    before = _product(shape[: source.axis])
    kept = [a for a in range(len(new)) if _product(new[:a]) == before and new[a] == shape[source.axis]]
    if not kept:
        return None
    axis = kept[0]
    return _per_part(splitter, node, source, axis, lambda part, size: (part, (*new[:axis], size, *new[axis + 1 :])))


def _expand(splitter: _Splitter, node: Node) -> _Parts | None:
    source, name = _only_first_is_split(splitter, node), _first(node)
    if source is None or name is None:
        return None
    new = node.type.shape
    axis = source.axis + len(new) - len(splitter.types[name].shape)
    return _per_part(splitter, node, source, axis, lambda part, size: (part, (*new[:axis], size, *new[axis + 1 :])))


_RULES: dict[str, Callable[[_Splitter, Node], _Parts | None]] = {
    **dict.fromkeys(_UNARY, _unary),
    **dict.fromkeys(_BINARY, _binary),
    "linear": _linear, "matmul": _matmul,
    "layer_norm": _layer_norm, "rms_norm": _layer_norm,
    "transpose": _transpose, "permute": _permute,
    "unsqueeze": _unsqueeze, "squeeze": _squeeze, "select": _select,
    "slice": _along_other_axis(1), "chunk": _along_other_axis(2), "split": _along_other_axis(2),
    "split_with_sizes": _along_other_axis(2), "softmax": _along_other_axis(1),
    GETITEM: _getitem,
    "view": _view, "reshape": _view, "_unsafe_view": _view, "expand": _expand,
}  # fmt: skip
