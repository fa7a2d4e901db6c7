"""A tower for some of its tokens: those whose patches changed; the others keep what they gave."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ttscompile.ir import pieces as names
from ttscompile.ir.evaluate import evaluator
from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, TensorType, backward_slice, copied
from ttscompile.ir.operations import Movement, operation
from ttscompile.ir.program import Program
from ttscompile.ir.tokens import ATTENTION, TokenStream, find_tokens

from .base import Pass, PassResult

_CLOSE = 1e-3
"""Share of the largest number by which the tower and all of its tokens may differ: rounding is below it."""


class ReuseTokens(Pass[Program, Program]):
    """Give each tower that is a vision transformer a second form, for any of its tokens.

    Before::

        frame_00  : %row : [B, 3, 64, 64] -> %feature
            %patches = aten.conv2d.default(%pixels, ..., [16, 16])
            %tokens : [B, 17, 128] = ...
            %k      : [B, 17, 128] = aten.linear.default(%normed, ...)

    After, beside it; in ``tokens_00`` there is one row, and B is the number of tokens::

        pixels_00 : %row -> %pixels                       # what patches are cut from
        tokens_00 : %pixels, %index : [B], %places, %rows : [2*B], %k.kept : [17, 1, 128]
                    -> %feature, %k.kept.new : [17, 1, 128]
            %tokens.changed : [1, B, 128] = aten.index_select.default(%tokens, 1, %index)
            %k.changed      : [1, B, 128] = aten.linear.default(%normed.changed, ...)
            %k.kept.new     = %k.kept with the rows %rows of %k.changed at %places
            %k              = %k.kept.new

    A value has a row for each token as long as nothing but attention brings tokens together. What attention reads of
    all tokens, and what follows after the last layer, is kept from frame to frame. Tokens in ``index`` are computed,
    and their rows are written to ``places``: their own, and as many more. Nothing else reads what was kept, so a
    runtime may have it written where it is. With all tokens it is the tower. Which token is of which patch is found on
    numbers.
    """

    def call(self, program: Program) -> PassResult[Program]:
        pieces, found, notes = program.pieces, dict[str, Graph](), list[str]()
        if pieces.tokens:
            return PassResult(program)
        for i, tower in enumerate(pieces.towers):
            stream = find_tokens(tower, program.weights)
            if isinstance(stream, str):
                notes.append(f"{names.frame_name(i)}: the whole frame is the unit: {stream}")
                continue
            graph = for_tokens(tower, stream)
            found |= {names.pixels_name(i): _pixels_graph(tower, stream), names.tokens_name(i): graph}
            kept = sum(math.prod(type_.at(1)) for name, type_ in graph.inputs.items() if name not in names.NOT_KEPT)
            notes.append(f"{names.frame_name(i)}: {stream.tokens} tokens, of which {kept * 4 / 1e6:.1f} MB are kept")
        if not found:
            return PassResult(program, tuple(notes))
        return PassResult(replace(program, pieces=replace(pieces, tokens=found)), tuple(notes))

    def ensures(self, program: Program) -> None:
        """With all of its tokens the second form gives what the tower gives."""
        pieces, rng = program.pieces, np.random.default_rng(0)
        for i, tower in enumerate(pieces.towers):
            if names.tokens_name(i) not in pieces.tokens:
                continue
            (name,) = tower.inputs
            row = torch.from_numpy(rng.standard_normal(tower.inputs[name].at(1), dtype=np.float32))
            graph = pieces.tokens[names.tokens_name(i)]
            kept = {n: torch.full(t.at(1), torch.nan) for n, t in graph.inputs.items() if n not in names.NOT_KEPT}
            tokens = torch.arange(next(iter(kept.values())).shape[0])
            with torch.no_grad():
                whole = evaluator(tower, program.weights)({name: row})
                (pixels,) = evaluator(pieces.tokens[names.pixels_name(i)], program.weights)({name: row})
                twice = {names.PLACES: tokens.repeat(2), names.ROWS: tokens.repeat(2)}
                parts = evaluator(graph, program.weights)({names.PIXELS: pixels, names.INDEX: tokens, **twice, **kept})
            for output, one, other in zip(tower.outputs, whole, parts, strict=False):
                if not torch.allclose(one, other, rtol=0, atol=_CLOSE * float(one.abs().max()), equal_nan=True):
                    raise self.fail(f"%{output} of all tokens is not what the tower gives.")


def for_tokens(tower: Graph, stream: TokenStream) -> Graph:
    """The tower for some of its tokens."""
    return _Changed(tower, stream).graph()


def _rowless(batch: Batch) -> int:
    """A size of one row: rows run one by one, so that the one symbolic size can be the number of tokens."""
    return batch.multiple


def _of_some(type_: TensorType, axis: int) -> TensorType:
    """The type of a value with the rows of some tokens alone."""
    return type_.resized(_rowless).with_axis(axis, Batch())


def _pixels_graph(tower: Graph, stream: TokenStream) -> Graph:
    """The row to what patches are cut from, under a name of its own."""
    graph = backward_slice(tower, (stream.pixels,), {})
    copy = copied(names.PIXELS, stream.pixels, tower.types()[stream.pixels])
    return replace(graph, inputs=tower.inputs, nodes=(*graph.nodes, copy), outputs=(names.PIXELS,))


@dataclass
class _Changed:
    """Writes the graph for some tokens: of a value ``v`` with a row for each, ``v.changed`` has theirs, and ``v`` all.

    Attributes:
        tower: what it does.
        stream: its tokens.
        nodes: written so far.
        inputs: what is kept, by name.
        outputs: what has to be kept, with its new rows.
        there: values that are written whole.
    """

    tower: Graph
    stream: TokenStream
    nodes: list[Node] = field(default_factory=list)
    inputs: dict[str, TensorType] = field(default_factory=dict)
    outputs: list[str] = field(default_factory=list)
    there: set[str] = field(default_factory=set)

    def graph(self) -> Graph:
        """All of it."""
        types, stream, axes = self.tower.types(), self.stream, self.stream.axes
        own = backward_slice(self.tower, self.tower.outputs, {stream.pixels: types[stream.pixels]})
        self.makers, self.types = own.producers(), types
        sizes = {names.INDEX: 1, names.PLACES: 2, names.ROWS: 2}
        numbers = {name: TensorType((Batch(size),), "int64") for name, size in sizes.items()}
        pixels = types[stream.pixels].resized(_rowless)
        self.nodes.append(copied(stream.pixels, names.PIXELS, pixels))
        for node in own.nodes:
            if node.name in axes and node.name != stream.entry:
                self._changed(node)
                continue
            for name in node.refs():
                self._whole(name)
            self.nodes.append(node.resized(_rowless))
            self.there.add(node.name)
            if node.name == stream.entry:
                self._gather(node.name, axes[node.name])
        for name in own.outputs:
            self._whole(name)
        given = {names.PIXELS: pixels, **numbers, **self.inputs}
        return Graph(given, own.constants, tuple(self.nodes), (*own.outputs, *self.outputs))

    def _gather(self, name: str, axis: int) -> Ref:
        if not any(node.name == f"{name}.changed" for node in self.nodes):
            args = (Ref(name), axis, Ref(names.INDEX))
            type_ = _of_some(self.types[name], axis)
            self.nodes.append(Node(f"{name}.changed", "aten.index_select.default", args, (), (type_,)))
        return Ref(f"{name}.changed")

    def _changed(self, node: Node) -> None:
        axes, axis = self.stream.axes, self.stream.axes[node.name]
        types = tuple(_of_some(type_, axis) for type_ in node.types)
        elementwise, behind = operation(node.op).elementwise, len(node.type.shape) - axis

        def operand(place: int, argument: Argument) -> Argument:
            if isinstance(argument, tuple):
                return tuple(operand(place, item) for item in argument)
            if not isinstance(argument, Ref):
                return _rowless(argument) if isinstance(argument, Batch) else argument
            if node.op == ATTENTION and place in (1, 2):
                self._whole(argument.name)
                return argument
            if argument.name in axes:
                return Ref(f"{argument.name}.changed")
            sizes = self.types[argument.name].shape
            if elementwise and len(sizes) >= behind and sizes[-behind] == self.stream.tokens:
                return self._gather(argument.name, len(sizes) - behind)
            if node.op == ATTENTION and sizes[-2] == self.stream.tokens:  # a mask, of which tokens see which
                return self._gather(argument.name, len(sizes) - 2)
            return argument

        args = tuple(operand(place, argument) for place, argument in enumerate(node.args))
        if node.op == "aten.reshape.default":
            args = (args[0], types[0].shape)
        kwargs = tuple((name, operand(-1, value)) for name, value in node.kwargs)
        self.nodes.append(replace(node, name=f"{node.name}.changed", args=args, kwargs=kwargs, types=types))

    def _whole(self, name: str) -> None:
        """See that a value is there with the rows of all tokens."""
        if name in self.there or name not in self.stream.axes:
            return
        self.there.add(name)
        node, axis = self.makers[name], self.stream.axes[name]
        type_ = node.type.resized(_rowless)
        if operation(node.op).movement in (Movement.RESHAPE, Movement.PERMUTE):
            for read in node.refs():
                self._whole(read)
            self.nodes.append(node.resized(_rowless))
            return
        front = (axis, *(a for a in range(len(type_.shape)) if a != axis))
        back = tuple(front.index(a) for a in range(len(front)))
        rest = tuple(type_.shape[a] for a in front[1:])
        all_rows, new_rows, placed = (replace(type_, shape=(n, *rest)) for n in (self.stream.tokens, Batch(), Batch(2)))
        kept, renewed = f"{name}.kept", names.renewed_name(f"{name}.kept")
        self.inputs[kept] = all_rows
        self.outputs.append(renewed)
        take, put = (Ref(f"{name}.rows"), 0, Ref(names.ROWS)), (Ref(kept), 0, Ref(names.PLACES), Ref(f"{name}.placed"))
        # Past axes of size 1 nothing moves, and nothing is to be copied.
        moves = any(size != 1 for size in type_.shape[:axis])

        def moved(result: str, read: str, order: tuple[int, ...], kind: TensorType) -> Node:
            how = ("aten.permute.default", order) if moves else ("aten.reshape.default", kind.shape)
            return Node(result, how[0], (Ref(read), how[1]), (), (kind,))

        self.nodes += [
            moved(f"{name}.rows", f"{name}.changed", front, new_rows),
            Node(f"{name}.placed", "aten.index_select.default", take, (), (placed,)),
            Node(renewed, "aten.index_copy.default", put, (), (all_rows,)),
            moved(name, renewed, back, type_),
        ]
