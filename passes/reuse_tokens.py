"""A tower, or the scene, for some of its tokens: those that changed; the others keep what they gave."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ttscompile.ir import pieces as names
from ttscompile.ir.evaluate import drawn, evaluator
from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, TensorType, backward_slice, reshaped
from ttscompile.ir.operations import Movement, operation
from ttscompile.ir.program import Program
from ttscompile.ir.tokens import ATTENTION, TokenStream, find_sequence, find_tokens, read_whole

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

    So does the scene, whose tokens are the rows of the sequence that its language model reads::

        pixels_scene : %feature, %words -> %pixels : [B, 1, 140, 960]    # a row is the patch of its token
        tokens_scene : %pixels, %words, %index, %places, %rows, %k.kept -> %k, %k.kept.new
    """

    def call(self, program: Program) -> PassResult[Program]:
        pieces, found, notes = program.pieces, dict[str, Graph](), list[str]()
        if pieces.tokens:
            return PassResult(program)
        for piece, graph in _candidates(program).items():
            scene = piece == names.SCENE
            stream = find_sequence(graph) if scene else find_tokens(graph, program.weights)
            if isinstance(stream, str):
                notes.append(f"{piece}: the whole {'scene' if scene else 'frame'} is the unit: {stream}")
                continue
            some = for_tokens(graph, stream)
            found |= {names.pixels_name(piece): _pixels_graph(graph, stream), names.tokens_name(piece): some}
            kept = sum(math.prod(type_.at(1)) for type_ in names.kept_inputs(some).values())
            notes.append(f"{piece}: {stream.tokens} tokens, of which {kept * 4 / 1e6:.1f} MB are kept")
        if not found:
            return PassResult(program, tuple(notes))
        return PassResult(replace(program, pieces=replace(pieces, tokens=found)), tuple(notes))

    def ensures(self, program: Program) -> None:
        """With all of its tokens the second form gives what the tower gives."""
        pieces, rng = program.pieces, np.random.default_rng(0)
        for piece, whole in _candidates(program).items():
            if (some := pieces.tokens.get(names.tokens_name(piece))) is None:
                continue
            pixels = pieces.tokens[names.pixels_name(piece)]
            given = {name: drawn(type_, 1, rng) for name, type_ in whole.inputs.items()}
            given |= {name: torch.full(type_.at(1), torch.nan) for name, type_ in names.kept_inputs(some).items()}
            tokens = torch.arange(next(iter(names.kept_inputs(some).values())).at(1)[0])
            given |= {names.INDEX: tokens, names.PLACES: tokens.repeat(2), names.ROWS: tokens.repeat(2)}
            results = list[tuple[torch.Tensor, ...]]()
            with torch.no_grad():
                for graph in (whole, pixels, some):
                    results.append(evaluator(graph, program.weights)({name: given[name] for name in graph.inputs}))
                    given |= zip(graph.outputs[:1] * (graph is pixels), results[-1], strict=False)
            for output, one, other in zip(whole.outputs, results[0], results[2], strict=False):
                if not torch.allclose(one, other, rtol=0, atol=_CLOSE * float(one.abs().max()), equal_nan=True):
                    raise self.fail(f"%{output} of all tokens is not what the tower gives.")


def _candidates(program: Program) -> dict[str, Graph]:
    """What may have tokens, by the name of its piece, towers first."""
    return {name: graph for name, graph in program.pieces.once().items() if name not in (names.FRAMES, names.CONDITION)}


def for_tokens(tower: Graph, stream: TokenStream) -> Graph:
    """The tower, or the scene, for some of its tokens."""
    return _Changed(tower, stream).graph()


def _rowless(batch: Batch) -> int:
    """A size of one row: rows run one by one, so that the one symbolic size can be the number of tokens."""
    return batch.multiple


def _of_some(type_: TensorType, axis: int) -> TensorType:
    """The type of a value with the rows of some tokens alone."""
    return type_.resized(_rowless).with_axis(axis, Batch())


def _pixels_type(type_: TensorType) -> TensorType:
    """Of what patches are cut from; the rows of a sequence are those of a picture of one channel."""
    return type_ if len(type_.shape) == 4 else replace(type_, shape=(type_.shape[0], 1, *type_.shape[1:]))


def _pixels_graph(tower: Graph, stream: TokenStream) -> Graph:
    """The row to what patches are cut from, under a name of its own."""
    graph = backward_slice(tower, (stream.pixels,), {})
    copy = reshaped(names.PIXELS, stream.pixels, _pixels_type(tower.types()[stream.pixels]))
    return replace(graph, nodes=(*graph.nodes, copy), outputs=(names.PIXELS,))


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
        self.nodes.append(reshaped(stream.pixels, names.PIXELS, pixels))
        if stream.entry == stream.pixels:
            self._enter(stream.entry)
        for node in own.nodes:
            if node.name in axes and node.name != stream.entry:
                self._changed(node)
                continue
            for name in node.refs():
                self._whole(name)
            self.nodes.append(node.resized(_rowless))
            if node.name == stream.entry:
                self._enter(node.name)
        for name in own.outputs:
            self._whole(name)
        beside = {name: type_.resized(_rowless) for name, type_ in own.inputs.items() if name != stream.pixels}
        given = {names.PIXELS: _pixels_type(pixels), **numbers, **beside, **self.inputs}
        return Graph(given, own.constants, tuple(self.nodes), (*own.outputs, *self.outputs))

    def _enter(self, name: str) -> None:
        """Take the rows of the tokens that are computed out of what is there for all."""
        self.there.add(name)
        self._gather(name, self.stream.axes[name])

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
        of_all = read_whole(node, axes)

        def operand(place: int, argument: Argument) -> Argument:
            if isinstance(argument, tuple):
                return tuple(operand(place, item) for item in argument)
            if not isinstance(argument, Ref):
                return _rowless(argument) if isinstance(argument, Batch) else argument
            if place in of_all:
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
        if node.op in ("aten.reshape.default", "aten.expand.default"):
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
        if operation(node.op).movement in (Movement.RESHAPE, Movement.PERMUTE, Movement.REPEAT):
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
