"""Split what is concatenated of parts with different binding times: tokens, and the features of a linear layer."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate, groupby

from ttscompile.ir.binding import bindings, input_bindings, join
from ttscompile.ir.dataflow import reachable_from
from ttscompile.ir.graph import Argument, Graph, Node, Ref, TensorType
from ttscompile.ir.operations import Movement, axis_after, joined_axis, operation
from ttscompile.ir.program import Binding, Captured, Cut

from .base import Pass, PassResult

_CAT, _LINEAR, _SLICE = "aten.cat.default", "aten.linear.default", "aten.slice.Tensor"


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
        if node.op == _CAT and self._split_cat(node):
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
                        f"declined to split further at %{node.name} = {node.op} ({node.place}):"
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
        self.nodes.append(Node(name, _CAT, args, (), (self.types[name],), "sunk by SplitTokens"))

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
        names, axis = _joined(node, self.types)
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
                name = self.emit(node, i, args, (node.type.with_axis(axis, size),))
            grouped.append(name)
        self.parts[node.name] = _Parts(axis, tuple(grouped), tuple(sizes))
        self.split_at.append(node.name)
        return True

    def slice_part(self, node: Node, name: str, axis: int, start: int, size: int, index: int) -> str:
        """Rows ``start .. start + size`` of an operand that is not split."""
        type_ = self.types[name].with_axis(axis, size)
        part = f"{node.name}.slice{index}"
        self.nodes.append(Node(part, _SLICE, (Ref(name), axis, start, start + size), (), (type_,), node.source))
        self.types[part], self.bindings[part] = type_, self.bindings[name]
        return part


def _parts(splitter: _Splitter, node: Node) -> _Parts | None:
    """The result of a node that treats tokens each for itself, a node a part; None if it mixes them or is not known."""
    row = operation(node.op)
    if row.elementwise:
        return _elementwise(splitter, node)
    split = [name for name in node.refs() if name in splitter.parts]
    if split != list(node.refs())[:1] or node.args[0] != Ref(split[0]):
        return None  # it reads more than one value in parts, or not in the first place
    source, shape = splitter.parts[split[0]], splitter.types[split[0]].shape
    if row.name == "expand":
        return _per_part(splitter, node, source, source.axis + len(node.type.shape) - len(shape), shaped=True)
    axis, shaped = axis_after(node, source.axis, splitter.types), row.movement is Movement.RESHAPE
    if shaped:
        node = replace(node, op="aten.reshape.default", kwargs=())
    return None if axis is None else _per_part(splitter, node, source, axis, shaped)


def _per_part(splitter: _Splitter, node: Node, source: _Parts, axis: int, shaped: bool = False) -> _Parts:
    """Emit ``node`` once a part; if it is ``shaped``, with the shape of the part as its second argument."""
    names = []
    for i, (name, size) in enumerate(zip(source.names, source.sizes, strict=True)):
        types = tuple(type_.with_axis(axis, size) for type_ in node.types)
        args = (Ref(name), types[0].shape) if shaped else (Ref(name), *node.args[1:])
        names.append(splitter.emit(node, i, args, types))
    return _Parts(axis, tuple(names), source.sizes)


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
        names.append(splitter.emit(node, i, tuple(args), (node.type.with_axis(axis, size),)))
    return _Parts(axis, tuple(names), sizes)


class SplitFeatures(Pass[Cut, Cut]):
    """Let each part of a feature vector meet its columns of the weight at its own binding time.

    The modulations of adaLN are linear in [timestep, observation]. Before::

        %f = aten.cat.default([%time, %observation], 1)          # step
        %m = aten.linear.default(%f, %w, %b)                     # step: all of it, for every step

    After::

        %m.part0 = aten.linear.default(%time, %w[:, :t], %b)     # a table in the artifact
        %m.part1 = aten.linear.default(%observation, %w[:, t:])  # once a call
        %m       = aten.add.Tensor(%m.part0, %m.part1)           # for every step, an addition

    The result differs from the original by rounding only.
    """

    def call(self, program: Cut) -> PassResult[Cut]:
        prologue, spec = program.prologue, program.spec
        known, producers, types = bindings(prologue, input_bindings(spec)), prologue.producers(), prologue.types()
        sums: dict[str, list[Node]] = {}
        for node in prologue.nodes:
            parts = _features(node, producers, types)
            if len({known[part] for part in parts}) > 1:
                sums[node.name] = _sum(node, parts, types)
        if not sums:
            return PassResult(program)
        note = f"{len(sums)} linear layers of features with different binding times became sums"
        return PassResult(replace(program, prologue=prologue.replaced(sums)), (note,))


class SplitStem(Pass[Captured, Captured]):
    """Let what a linear layer reads beside the sample meet its columns of the weight outside of the loop.

    Actions and their time are concatenated so in flow matching, in pi0 say. Before::

        %wide = aten.expand.default(%time, [B, 50, 720])
        %f    = aten.cat.default([%actions, %wide], 2)
        %h    = aten.linear.default(%f, %w, %b)                  # in the loop

    After::

        %h.part0 = aten.linear.default(%actions, %w[:, :720], %b)
        %h.part1 = aten.linear.default(%time, %w[:, 720:])       # of one row: a table in the artifact
        %h       = aten.add.Tensor(%h.part0, %h.part1)

    The result differs from the original by rounding only. ``CleanUp`` then makes constants of the columns, before a cut
    puts them into the prologue: what the loop reads of that it reads a step at a time.
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph = program.denoiser
        loop, producers = reachable_from(graph, [program.spec.sample_argument]), graph.producers()
        sums, notes, types = dict[str, list[Node]](), list[str](), graph.types()
        for node in graph.nodes:
            parts = _features(node, producers, types)
            moving = [i for i, part in enumerate(parts) if part in loop]
            if len(parts) > 1 and len(moving) == 1 and list(node.refs())[1] in graph.constants:
                own = [part if part in loop else _narrow(part, producers, types) for part in parts]
                sums[node.name] = _sum(node, own, types, *moving)
                notes.append(f"%{node.name} ({node.place}): one of {len(parts)} parts is in the loop")
        split = replace(program, denoiser=graph.replaced(sums)) if sums else program
        return PassResult(split, tuple(notes))


def _narrow(part: str, producers: Mapping[str, Node], types: Mapping[str, TensorType]) -> str:
    """What was repeated along other axes than the last to make a value; itself where it is not known."""
    node = producers.get(part)
    if node is None or node.op != "aten.expand.default":
        return part
    (source,) = node.refs()
    before = types[source].shape
    return source if len(before) == len(node.type.shape) and before[-1] == node.type.shape[-1] else part


def _features(node: Node, producers: Mapping[str, Node], types: Mapping[str, TensorType]) -> list[str]:
    """The features that a node reads, if it is a linear layer and they are concatenated along its last axis."""
    if node.op != _LINEAR:
        return []
    source, weight = node.args[0], node.args[1]
    cat = producers.get(source.name) if isinstance(source, Ref) else None
    if cat is None or cat.op != _CAT or not isinstance(weight, Ref) or len(types[weight.name].shape) != 2:
        return []
    names, axis = _joined(cat, types)
    fits = axis == len(cat.type.shape) - 1 and all(isinstance(types[name].shape[-1], int) for name in names)
    return names if fits else []


def _joined(cat: Node, types: Mapping[str, TensorType]) -> tuple[list[str], int]:
    """What a concatenation joins, and along which axis.

    Nothing if one part has another dtype: apart it would be computed with in its own.
    """
    names = list(cat.refs())
    alike = all(types[name].dtype == cat.type.dtype for name in names)
    return names if alike else [], joined_axis(cat)


def _sum(node: Node, parts: list[str], types: Mapping[str, TensorType], first: int = 0) -> list[Node]:
    """The sum of what each part makes with its columns; it begins with ``first``, which has all rows and the bias."""
    weight = node.args[1]
    assert isinstance(weight, Ref)
    matrix, nodes = types[weight.name], list[Node]()
    ends = list(accumulate(_width(types[part]) for part in parts))

    def emit(name: str, op: str, args: tuple[Argument, ...], type_: TensorType) -> Ref:
        nodes.append(Node(name, op, args, (), (type_,), node.source))
        return Ref(name)

    order, total = [first, *(i for i in range(len(parts)) if i != first)], Ref("")
    for place, index in enumerate(order):
        part, size = parts[index], _width(types[parts[index]])
        cut = (weight, 1, ends[index] - size, ends[index])
        columns = emit(f"{node.name}.columns{index}", _SLICE, cut, matrix.with_axis(1, size))
        made = TensorType((*types[part].shape[:-1], matrix.shape[0]), node.type.dtype)
        args = (Ref(part), columns, *(() if place else node.args[2:]))  # the bias once
        linear = emit(f"{node.name}.part{index}", _LINEAR, args, made)
        name = node.name if place == len(parts) - 1 else f"{node.name}.sum{place}"
        total = emit(name, "aten.add.Tensor", (total, linear), node.type) if place else linear
    return nodes


def _width(type_: TensorType) -> int:
    size = type_.shape[-1]
    assert isinstance(size, int)
    return size
