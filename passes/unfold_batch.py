"""Give what crosses between the pieces of the program an axis of streams, where the batch is a multiple of B."""

from dataclasses import replace

from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Cut, Loop
from ttscompile.ir.rows import Rows, crossing_inputs, crossing_outputs, unfold

from .base import Pass, PassResult


class UnfoldBatch(Pass[Cut, Cut]):
    """Let a doubled batch cross as ``[2, B, ...]``, so that caches, plans and tables are each stream's own.

    Before (guidance inside the denoiser)::

        block(%x : [2*B, T, E], %context : [2*B, E])

    After::

        block(%x.rows : [2, B, T, E], %context.rows : [2, B, E])
          %x       = aten.reshape.default(%x.rows, [2*B, T, E])
          %context = aten.reshape.default(%context.rows, [2*B, E])
    """

    def call(self, program: Cut) -> PassResult[Cut]:
        loop, stream = program.loop, program.blocks[0].stream
        rows = unfold(program.denoiser, (*loop.contexts, stream))
        if not rows:
            return PassResult(program)
        blocks = program.blocks
        if stream in rows:
            # All values of the residual stream are made from the first, and residuals added to it: rows are alike.
            like = rows[stream]
            for piece in (*loop.blocks, loop.tail):
                for name in (piece.stream, *(() if piece is loop.tail else piece.graph.outputs)):
                    rows[name] = Rows(name, like.type, f"{name}.rows", like.unfolded)
            blocks = tuple(replace(b, type=like.unfolded) for b in blocks)
        crossed = []
        for piece in loop.loop.values():
            graph = crossing_outputs(crossing_inputs(piece.graph, rows), rows)
            stream = rows[piece.stream].crossing if piece.stream in rows else piece.stream
            crossed.append(LoopPiece(graph, stream))
        stem, *inner, tail = crossed
        prologue = crossing_outputs(program.prologue, rows)
        new = replace(program, blocks=blocks, prologue=prologue, loop=Loop(stem, tuple(inner), tail))
        return PassResult(new, (f"{len(rows)} values have several rows a stream and cross with an axis of streams",))
