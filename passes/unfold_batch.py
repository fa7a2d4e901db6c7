"""Give what crosses between the pieces of the program an axis of streams, where the batch is a multiple of B."""

from __future__ import annotations

from dataclasses import replace

from ttscompile.ir.graph import Graph
from ttscompile.ir.program import Pieces, Program
from ttscompile.ir.rows import Rows, crossing_inputs, crossing_outputs, unfold

from .base import Pass, PassResult


class UnfoldBatch(Pass):
    """Let a doubled batch cross as ``[2, B, ...]``, so that caches, plans and tables are each stream's own.

    Before (guidance inside the denoiser)::

        block(%x : [2*B, T, E], %context : [2*B, E])

    After::

        block(%x.rows : [2, B, T, E], %context.rows : [2, B, E])
          %x       = aten.reshape.default(%x.rows, [2*B, T, E])
          %context = aten.reshape.default(%context.rows, [2*B, E])
    """

    def requires(self, program: Program) -> None:
        """The program is cut, its prologue is still whole."""
        if program.pieces is None or program.pieces.bindings:
            raise self.fail("runs between partition and hoist.")

    def call(self, program: Program) -> PassResult:
        """Unfold the stream and the contexts."""
        pieces = program.pieces
        assert pieces is not None
        stream = program.blocks[0].stream
        loop = [pieces.stem, *pieces.blocks, pieces.tail]
        contexts = list(dict.fromkeys(name for graph in loop for name in list(graph.inputs)[1:]))
        rows = unfold(program.denoiser, (*contexts, stream))
        if not rows:
            return PassResult(program, False)
        blocks = program.blocks
        if stream in rows:
            # Every value of the stream is made from the first, and residuals are added to it: their rows are alike.
            like = rows[stream]
            for graph in loop[1:]:
                for name in (next(iter(graph.inputs)), *(graph.outputs if graph is not pieces.tail else ())):
                    rows[name] = Rows(name, like.type, f"{name}.rows", like.unfolded)
            blocks = tuple(replace(b, type=like.unfolded) for b in blocks)
        return PassResult(
            replace(program, pieces=_crossing(pieces, rows), blocks=blocks),
            True,
            (f"{len(rows)} values have several rows a stream and cross with an axis of streams",),
        )


def _crossing(pieces: Pieces, rows: dict[str, Rows]) -> Pieces:
    def through(graph: Graph) -> Graph:
        return crossing_outputs(crossing_inputs(graph, rows), rows)

    return replace(
        pieces,
        condition=crossing_outputs(pieces.condition, rows),
        stem=through(pieces.stem),
        blocks=tuple(map(through, pieces.blocks)),
        tail=crossing_inputs(pieces.tail, rows),
    )
