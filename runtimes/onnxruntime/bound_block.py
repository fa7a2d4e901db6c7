"""A residual block tied to arrays, and how the values that it reads at a step get there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ttscompile.artifact.manifest import PieceRecord
from ttscompile.ir.program import Binding

from .contexts import ContextValues
from .sessions import Array, Bound


class BoundBlock:
    """A block bound to arrays for all streams, or for n of them.

    Args:
        session: of the block.
        piece: of the block.
        contexts: values for all streams.
        axis: of the streams in the residual stream.
        stream: what it reads.
        residual: what it writes.
        count: n.
        whole: whether these are all streams.
    """

    def __init__(
        self,
        session: Any,
        piece: PieceRecord,
        contexts: ContextValues,
        axis: int,
        stream: Array,
        residual: Array,
        count: int,
        whole: bool,
    ) -> None:
        self._stream, self._axis = stream, axis
        self.rows = np.moveaxis(residual, axis, 0)
        self._by_step: list[tuple[Array, Array]] = []  # where it is read from, and one value a step
        self._gathered: list[tuple[Array, Array, int, bool]] = []  # where, value, axis of the streams, one a step
        arrays: dict[str, Array] = {}
        for name, (context, value) in contexts.of_piece(piece).items():
            batch, stepwise = context.type.batch_axis, context.binding is not Binding.CONDITION
            if not stepwise and (whole or batch is None):
                arrays[name] = value
                continue
            arrays[name] = np.zeros(context.type.at(count), context.type.dtype)
            if whole or batch is None:
                self._by_step.append((arrays[name], value))
            elif context.binding is Binding.TABLE:  # the same for every stream
                self._by_step.append((arrays[name], value.take(np.arange(count), axis=batch + 1)))
            else:
                self._gathered.append((arrays[name], value, batch, stepwise))
        self._own = (*arrays.values(), stream, residual) if not whole else tuple(to for to, _ in self._by_step)
        inputs = {name: stream if name == piece.stream else arrays[name] for name in piece.inputs}
        self._bound = Bound(session, inputs, {piece.outputs[0]: residual})

    @property
    def nbytes(self) -> int:
        """Memory of the arrays that are its own."""
        return sum(array.nbytes for array in self._own)

    def run(self, k: int) -> None:
        """Run at step k on the stream as it is."""
        for to, values in self._by_step:
            np.copyto(to, values[k])
        self._bound.run()

    def gather(self, k: int, streams: Sequence[int], stream: Array) -> None:
        """Run at step k on these streams of the batch's ``stream``."""
        np.take(stream, streams, axis=self._axis, out=self._stream, mode="clip")
        for to, value, axis, stepwise in self._gathered:
            np.take(value[k] if stepwise else value, streams, axis=axis, out=to, mode="clip")
        self.run(k)
