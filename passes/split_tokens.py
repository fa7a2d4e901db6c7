"""Split a concatenation of tokens with different binding times, as far down as the work on it is token-wise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import groupby

from ttscompile.ir.binding import bindings, input_bindings, join
from ttscompile.ir.graph import GETITEM, Argument, Batch, Graph, Node, Ref, Size, TensorType
from ttscompile.ir.operations import Movement, axes_along, operation, permutation
from ttscompile.ir.program import Binding, Cut

from .base import Pass, PassResult


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
            parts = _parts(self, node)
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
        parts = self.parts.get(name)
        if parts is None or name in self.whole:
            return
        self.whole.add(name)
        args = (tuple(Ref(part) for part in parts.names), parts.axis)
        self.nodes.append(Node(name, "aten.cat.default", args, (), (self.types[name],), "sunk by SplitTokens"))

    def emit(self, node: Node, index: int, args: tuple[Argument, ...], types: tuple[TensorType, ...]) -> str:
        """Add the ``index``-th part of ``node`` and return its name."""
        name = f"{node.name}.part{index}"
        part = replace(node, name=name, args=args, types=types)
        self.nodes.append(part)
        self.types[name] = types[0]
        self.bindings[name] = reduce(join, (self.bindings[n] for n in part.refs()), Binding.CONSTANT)
        return name

    def _split_cat(self, node: Node) -> bool:
        if self.bindings[node.name] is not Binding.STEP:
            return False  # all of it leaves the loop as it is
        operands = node.args[0]
        assert isinstance(operands, tuple)
        names = [o.name for o in operands if isinstance(o, Ref)]
        if any(self.types[name].dtype != node.type.dtype for name in names):
            return False  # apart, what is another dtype in the whole would be computed with in its own
        axis = node.args[1] if len(node.args) > 1 else 0
        assert isinstance(axis, int)
        axis %= len(node.type.shape)
        pieces: list[tuple[str, int]] = []
        for name in names:
            inner = self.parts.get(name)
            if inner is not None and inner.axis == axis:
                pieces += zip(inner.names, inner.sizes, strict=True)
            elif inner is None and isinstance(size := self.types[name].shape[axis], int):
                pieces.append((name, size))
            else:
                return False
        groups = [list(group) for _, group in groupby(pieces, key=lambda piece: self.bindings[piece[0]])]
        if len(groups) < 2:
            return False
        grouped, sizes = [], [sum(size for _, size in group) for group in groups]
        for i, (group, size) in enumerate(zip(groups, sizes, strict=True)):
            name = group[0][0]
            if len(group) > 1:
                args = (tuple(Ref(part) for part, _ in group), axis)
                name = self.emit(node, i, args, (_resized(node.type, axis, size),))
            grouped.append(name)
        self.parts[node.name] = _Parts(axis, tuple(grouped), tuple(sizes))
        self.split_at.append(node.name)
        return True

    def slice_part(self, node: Node, name: str, axis: int, start: int, size: int, index: int) -> str:
        """Rows ``start .. start + size`` of an operand that is not split."""
        type_ = _resized(self.types[name], axis, size)
        part = f"{node.name}.slice{index}"
        args = (Ref(name), axis, start, start + size)
        self.nodes.append(Node(part, "aten.slice.Tensor", args, (), (type_,), node.source))
        self.types[part], self.bindings[part] = type_, self.bindings[name]
        return part


def _resized(type_: TensorType, axis: int, size: int) -> TensorType:
    return replace(type_, shape=(*type_.shape[:axis], size, *type_.shape[axis + 1 :]))


def _parts(splitter: _Splitter, node: Node) -> _Parts | None:
    """The result of a node that treats tokens each for itself, a node a part; None if it mixes them or is not known."""
    row = operation(node.op)
    if row.elementwise:
        return _elementwise(splitter, node)
    split = [name for name in node.refs() if name in splitter.parts]
    if split != list(node.refs())[:1] or node.args[0] != Ref(split[0]):
        return None  # it reads more than one value in parts, or not in the first place
    source, type_ = splitter.parts[split[0]], splitter.types[split[0]]
    axis, rank, new = source.axis, len(type_.shape), node.type.shape
    if row.movement is Movement.RESHAPE:
        return _reshaped(splitter, node, source, type_)
    if row.movement is Movement.PERMUTE:
        return _per_part(splitter, node, source, permutation(node, rank).index(axis))
    if row.name == "expand":
        axis += len(new) - rank
        return _per_part(splitter, node, source, axis, shaped=True)
    if row.along is not None and len(along := axes_along(node, rank)) == 1:
        (across,) = along
        # A selection leaves its axis out.
        return None if across == axis else _per_part(splitter, node, source, axis - (len(new) < rank and across < axis))
    if row.mixes is not None:
        mixed = row.mixes(node, splitter.types)
        return None if mixed is None or axis >= rank - mixed else _per_part(splitter, node, source, axis)
    return _per_part(splitter, node, source, axis) if node.op == GETITEM else None


def _per_part(splitter: _Splitter, node: Node, source: _Parts, axis: int, shaped: bool = False) -> _Parts:
    """Emit ``node`` once a part; if it is ``shaped``, with the shape of the part as its second argument."""
    names = []
    for i, (name, size) in enumerate(zip(source.names, source.sizes, strict=True)):
        types = tuple(_resized(type_, axis, size) for type_ in node.types)
        args = (Ref(name), types[0].shape) if shaped else (Ref(name), *node.args[1:])
        names.append(splitter.emit(node, i, args, types))
    return _Parts(axis, tuple(names), source.sizes)


def _reshaped(splitter: _Splitter, node: Node, source: _Parts, type_: TensorType) -> _Parts | None:
    """The split is kept if the token axis survives: the sizes before it, and itself, have the same product."""
    new, before = node.type.shape, _factors(type_.shape[: source.axis])
    kept = [a for a, size in enumerate(new) if size == type_.shape[source.axis] and _factors(new[:a]) == before]
    if not kept:
        return None
    node = replace(node, op="aten.reshape.default", kwargs=())
    return _per_part(splitter, node, source, kept[0], shaped=True)


def _factors(shape: Sequence[Size]) -> tuple[int, int]:
    """Numbers and batches in a product of sizes."""
    numbers = math.prod(n.multiple if isinstance(n, Batch) else n for n in shape)
    return numbers, sum(isinstance(n, Batch) for n in shape)


def _elementwise(splitter: _Splitter, node: Node) -> _Parts | None:
    """Parts of all operands, the others of which are cut where they are not broadcast along the tokens."""
    rank = len(node.type.shape)
    places = {name: rank - len(splitter.types[name].shape) for name in node.refs()}
    parts = {name: splitter.parts[name] for name in places if name in splitter.parts}
    splits = {(part.axis + places[name], part.sizes) for name, part in parts.items()}
    if len(splits) != 1:
        return None
    ((axis, sizes),) = splits
    names: list[str] = []
    for i, size in enumerate(sizes):
        args: list[Argument] = []
        for position, argument in enumerate(node.args):
            if isinstance(argument, Ref) and argument.name in parts:
                argument = Ref(parts[argument.name].names[i])
            elif isinstance(argument, Ref):
                shape, own = splitter.types[argument.name].shape, axis - places[argument.name]
                if own >= 0 and shape[own] != 1:
                    index = i * len(node.args) + position
                    argument = Ref(splitter.slice_part(node, argument.name, own, sum(sizes[:i]), size, index))
            args.append(argument)
        names.append(splitter.emit(node, i, tuple(args), (_resized(node.type, axis, size),)))
    return _Parts(axis, tuple(names), sizes)
