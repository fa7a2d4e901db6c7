"""Cut the denoiser into prologue, stem, blocks and tail along its residual stream."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ttscompile.ir.binding import numbering, one_step_at_a_time
from ttscompile.ir.dataflow import reachable_from
from ttscompile.ir.graph import Graph, Node, Ref, TensorType, backward_slice
from ttscompile.ir.program import Pieces, Program

from .base import Pass, PassResult


class Partition(Pass):
    """Outline the pieces of the loop as graphs of their own.

    Before::

        prediction = denoiser(sample, timestep, obs)

    After, wired by the names of values::

        contexts   = prologue(timestep, obs)            # pieces.condition, until hoist splits it
        stream     = stem(sample, contexts)
        residual_i = block_i(stream, contexts)          # stream <- stream + residual_i
        prediction = tail(stream, contexts)
    """

    def requires(self, program: Program) -> None:
        """The block table exists and the program is not cut yet."""
        if not program.blocks:
            raise self.fail("the program has no block table; run find_residual_blocks first.")
        if program.pieces is not None:
            raise self.fail("the program is already cut into pieces.")

    def call(self, program: Program) -> PassResult:
        """Cut along ``program.blocks``."""
        graph, spec, blocks = program.denoiser, program.spec, program.blocks
        types = graph.types()
        loop = reachable_from(graph, [spec.sample_argument])
        # What a loop node reads from outside the loop; constants belong to the pieces themselves.
        own = loop | numbering(graph) | one_step_at_a_time(graph, spec)
        outside = {
            name: types[name]
            for node in graph.nodes
            if node.name in own
            for name in node.refs()
            if name not in own and name not in graph.constants
        }

        def outline(start: str, result: str) -> Graph:
            piece = backward_slice(graph, (result,), {start: types[start], **outside})
            if start not in piece.inputs:  # the result does not read the stream: keep the signature
                piece = replace(piece, inputs={start: types[start], **piece.inputs})
            return _own_output(piece)

        stem = outline(spec.sample_argument, blocks[0].stream)
        tail = outline(blocks[-1].result, graph.outputs[0])
        cut = []
        for block in blocks:
            if block.residual is not None:
                cut.append(outline(block.stream, block.residual))
            else:
                cut.append(_difference(outline(block.stream, block.result), block.stream, block.type))
        pieces = Pieces(
            condition=_prologue(graph, outside, spec.sample_argument),
            step=None,
            stem=stem,
            blocks=tuple(cut),
            tail=tail,
        )
        sizes = {"prologue": pieces.condition, "stem": stem, "tail": tail}
        counts = [f"{name} {len(graph.nodes)}" for name, graph in sizes.items()]
        counts.insert(2, f"{len(cut)} blocks {sum(len(c.nodes) for c in cut)}")
        return PassResult(replace(program, pieces=pieces), True, ("nodes: " + ", ".join(counts),))

    def ensures(self, program: Program) -> None:
        """Every loop piece reads its stream, and otherwise what the prologue gives."""
        pieces = program.pieces
        assert pieces is not None
        for graph in (pieces.stem, *pieces.blocks, pieces.tail):
            if unknown := set(list(graph.inputs)[1:]).difference(pieces.condition.outputs):
                raise self.fail(f"a loop piece reads {sorted(unknown)}, which the prologue does not give.")


def _prologue(graph: Graph, outside: Iterable[str], sample: str) -> Graph:
    prologue = backward_slice(graph, tuple(outside), {})
    return replace(prologue, inputs={n: t for n, t in graph.inputs.items() if n != sample})


def _own_output(piece: Graph) -> Graph:
    """Give a piece whose output is its own input (no stem, say) a node to compute."""
    (output,) = piece.outputs
    if output not in piece.inputs and output not in piece.constants:
        return piece
    type_ = piece.types()[output]
    clone = Node(f"{output}.copy", "aten.clone.default", (Ref(output),), (), (type_,))
    return replace(piece, nodes=(*piece.nodes, clone), outputs=(clone.name,))


def _difference(piece: Graph, stream: str, type_: TensorType) -> Graph:
    (result,) = piece.outputs
    difference = Node(f"{result}.residual", "aten.sub.Tensor", (Ref(result), Ref(stream)), (), (type_,))
    return replace(piece, nodes=(*piece.nodes, difference), outputs=(difference.name,))
