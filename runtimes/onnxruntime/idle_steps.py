"""Steps without a computed block, in numpy, where the network allows it (``ir.idle_form`` says what is computed).

A step's arrays have the size of the sample, and a call of numpy on them takes half a microsecond; the same step through
the session of ``advance`` takes 37 us at Push-T's size, and 14 us so. Sample, prediction and what else the update reads
lie one behind the other, so that every operation has plain memory to work on.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.correction import FEATURES, remember
from ttscompile.core.spec import FloatArray, SamplerTable
from ttscompile.core.update import clip_of, rows
from ttscompile.ir.pieces import BASE, PRODUCT, SHIFT, TOTAL

from .sessions import Bound

WORTH = 3
"""So many idle steps in a row are quicker here; one or two are not, since the stem has to run once more after them."""


class IdleSteps:
    """Arrays for B streams, whose residual stream has the shape ``hidden``, and samples ``(T, D)``.

    Attributes:
        total: what the steps add to the residual stream, of its shape; read by ``prepare``.
        history: of the correction, ``[D, B, 4 T]``, as it is after the last step that was run.
    """

    def __init__(
        self, session: Any, sampler: SamplerTable, sample: tuple[int, int], streams: int, hidden: tuple[int, ...]
    ) -> None:
        horizon, dimensions = sample
        self._horizon, self._memories = horizon, sampler.memories
        shape = (dimensions, streams, horizon)
        self.total = np.zeros(hidden, np.float32)
        product, shift = session.run([PRODUCT, SHIFT], {TOTAL: self.total})
        self._product, self._shift = np.ascontiguousarray(product), np.broadcast_to(shift, shape).copy()
        self._held = not product.any()  # the prediction is the total's, whatever the sample is
        self._base = np.zeros((len(product), streams, horizon), np.float32)
        self._prepare = Bound(session, {TOTAL: self.total}, {BASE: self._base})
        clip = clip_of(sampler)
        self._clip = None if clip is None else (np.full(shape, -clip, np.float32), np.full(shape, clip, np.float32))
        before = 2 + (self._clip is not None)
        parts = np.zeros((before + self._memories, *shape), np.float32)  # sample, prediction, denoised, memories
        self._parts, self._memory = parts, parts[before:]
        self._features = np.zeros((dimensions, streams, rows(sampler, horizon)), np.float32)
        first, last = 2 * horizon, FEATURES * horizon
        self.history = self._features[:, :, first:last]
        self._copies = [(_by_part(self._features[:, :, :first], horizon), parts[:2])]
        if len(parts) > 2:
            self._copies.append((_by_part(self._features[:, :, last:], horizon), parts[2:]))
        self._to_x0 = np.stack([sampler.sample_to_x0, sampler.out_to_x0], axis=1)[:, None]

    def enter(self, sample: FloatArray, history: FloatArray, memory: FloatArray | None) -> None:
        """Take in the state before a step: ``[D, B, T]``, ``[D, B, 4 T]`` and, with memories, ``[D, B, S T]``."""
        np.copyto(self._parts[0], sample)
        np.copyto(self.history, history)
        if memory is not None:
            np.copyto(self._memory, _by_part(memory, self._horizon))

    def leave(self, sample: FloatArray, history: FloatArray, memory: FloatArray | None) -> None:
        """Write the state after the steps to such arrays."""
        np.copyto(sample, self._parts[0])
        np.copyto(history, self.history)
        if memory is not None:
            np.copyto(_by_part(memory, self._horizon), self._memory)

    def prepare(self) -> None:
        """Take in ``total``."""
        self._prepare.run()

    def run(self, first: int, stop: int, updates: Array, offsets: Array, anchors: Sequence[bool]) -> None:
        """The steps ``first`` to ``stop - 1``, which all add ``total``.

        Updates are ``[K, G, R, (1 + S) T]``, offsets ``[K, D, B, T]``; ``anchors`` enter the history.
        """
        dot, add = np.dot, np.add
        (sample, prediction), product, base = self._parts[:2], self._product, self._base
        count, horizon = len(sample), self._horizon
        read = self._parts[:2].reshape(2, -1)
        y = np.empty_like(base)
        norm, numerator = y[: count + 1], y[count + 1 :]
        squares, deviation = np.empty_like(norm), np.empty_like(sample)
        flat_y, flat_squares = y.reshape(len(y), -1), squares.reshape(len(squares), -1)
        flat_sample, flat_deviation = sample.reshape(count, -1), deviation.reshape(count, -1)
        ones = np.ones((count, count + 1), np.float32)  # sums the squares, and repeats the sum for every dimension
        result = np.empty((*self._features.shape[:2], (1 + self._memories) * horizon), np.float32)
        next_sample, next_memory = result[:, :, :horizon], _by_part(result[:, :, horizon:], horizon)
        for k in range(first, stop):
            if k == first or not self._held:
                dot(product, flat_sample, out=flat_y)
                add(y, base, out=y)
                np.multiply(norm, norm, out=squares)
                dot(ones, flat_squares, out=flat_deviation)
                np.sqrt(deviation, out=deviation)
                np.divide(numerator, deviation, out=prediction)
                add(prediction, self._shift, out=prediction)
            if self._clip is not None:
                denoised, (low, high) = self._parts[2], self._clip
                dot(self._to_x0[k], read, out=denoised.reshape(1, -1))
                np.maximum(denoised, low, out=denoised)
                np.minimum(denoised, high, out=denoised)
            for to, values in self._copies:
                to[...] = values
            np.matmul(self._features, updates[k], out=result)
            add(next_sample, offsets[k], out=sample)
            if self._memories:
                self._memory[...] = next_memory
            if anchors[k]:
                remember(self.history, self._features[:, :, :horizon], self._features[:, :, horizon : 2 * horizon])


def _by_part(array: FloatArray, horizon: int) -> FloatArray:
    """``[D, B, n T]`` seen as ``[n, D, B, T]``."""
    return array.reshape(*array.shape[:2], array.shape[2] // horizon, horizon).transpose(2, 0, 1, 3)
