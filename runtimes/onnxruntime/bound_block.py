"""A residual block tied to arrays, and how the values that it reads at a step get there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ttscompile.ir.program import Binding

from .sessions import Array

if TYPE_CHECKING:
    from .workspace import Workspace


class BoundBlock:
    """A block bound to arrays for n of the streams, and how the contexts of a step get there.

    Args:
        work: has the values of the contexts.
        b: the block.
        count: n.
        stream: what it reads.
        residual: what it writes.
    """

    def __init__(self, work: Workspace, b: int, count: int, stream: Array, residual: Array) -> None:
        self._stream, self._axis = stream, work.axis  # not the workspace: that has us
        self.rows = np.moveaxis(residual, work.axis, 0) if work.streams > 1 else residual
        self._by_step: list[tuple[Array, Array]] = []  # where it is read from, and one value a step
        self._gathered: list[tuple[Array, Array, int, bool]] = []  # where, value, axis of the streams, one a step
        whole = count == work.streams
        arrays: dict[str, Array] = {}
        for name, (context, value) in work.contexts_of(b).items():
            axis, stepwise = context.type.batch_axis, context.binding is not Binding.CONDITION
            if not stepwise and (whole or axis is None):
                arrays[name] = value
                continue
            arrays[name] = np.zeros(context.type.at(count), context.type.dtype)
            if whole or axis is None:
                self._by_step.append((arrays[name], value))
            elif context.binding is Binding.TABLE:  # the same for every stream
                self._by_step.append((arrays[name], value.take(np.arange(count), axis=axis + 1)))
            else:
                self._gathered.append((arrays[name], value, axis, stepwise))
        self._own = (*arrays.values(), stream, residual) if not whole else tuple(to for to, _ in self._by_step)
        self._bound = work.bound_block(b, stream, residual, arrays)

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
