"""Cut the denoiser into prologue, stem, blocks and tail along its residual stream."""

from dataclasses import dataclass, replace

from ttscompile.ir.binding import numbering, one_step_at_a_time
from ttscompile.ir.dataflow import reachable_from, read_from_outside
from ttscompile.ir.graph import Graph, Node, Ref, backward_slice, copied
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Block, Captured, Cut, Loop

from .base import Pass, PassResult


@dataclass(frozen=True)
class Partition(Pass[Captured, Cut]):
    """Outline the pieces of the loop as graphs of their own.

    Before::

        prediction = denoiser(sample, timestep, obs)

    After, wired by the names of values::

        contexts   = prologue(timestep, obs)
        stream     = stem(sample, contexts)
        residual_i = block_i(stream, contexts)          # stream <- stream + residual_i
        prediction = tail(stream, contexts)
    """

    blocks: tuple[Block, ...]

    def call(self, program: Captured) -> PassResult[Cut]:
        graph, spec, blocks = program.denoiser, program.spec, self.blocks
        types, reached = graph.types(), reachable_from(graph, [spec.sample_argument])
        # What a loop node reads from outside the loop; constants belong to the pieces themselves.
        outside = read_from_outside(graph, reached | numbering(graph) | one_step_at_a_time(graph, spec))

        def outline(start: str, result: str) -> LoopPiece:
            piece = backward_slice(graph, (result,), {start: types[start], **outside})
            if start not in piece.inputs:  # the result does not read the residual stream: keep the signature
                piece = replace(piece, inputs={start: types[start], **piece.inputs})
            return LoopPiece(_own_output(piece), start)

        prologue = backward_slice(graph, tuple(outside), {})
        prologue = replace(prologue, inputs={n: t for n, t in graph.inputs.items() if n != spec.sample_argument})
        loop = Loop(
            stem=outline(spec.sample_argument, blocks[0].stream),
            blocks=tuple(
                _difference(outline(b.stream, b.result)) if b.residual is None else outline(b.stream, b.residual)
                for b in blocks
            ),
            tail=outline(blocks[-1].result, graph.outputs[0]),
        )
        inside = sum(len(piece.graph.nodes) for piece in loop.blocks)
        early, stem, tail = (len(graph.nodes) for graph in (prologue, loop.stem.graph, loop.tail.graph))
        note = f"nodes: prologue {early}, stem {stem}, {len(blocks)} blocks {inside}, tail {tail}"
        return PassResult(Cut(**program.carried, blocks=blocks, prologue=prologue, loop=loop), (note,))


def _own_output(piece: Graph) -> Graph:
    """Give a piece whose output is its own input (no stem, say) a node to compute."""
    (output,) = piece.outputs
    if output not in piece.inputs and output not in piece.constants:
        return piece
    copy = copied(f"{output}.copy", output, piece.types()[output])
    return replace(piece, nodes=(*piece.nodes, copy), outputs=(copy.name,))


def _difference(piece: LoopPiece) -> LoopPiece:
    graph = piece.graph
    (result,) = graph.outputs
    difference = Node(f"{result}.residual", "aten.sub.Tensor", (Ref(result), Ref(piece.stream)), (), (piece.type,))
    return replace(piece, graph=replace(graph, nodes=(*graph.nodes, difference), outputs=(difference.name,)))
