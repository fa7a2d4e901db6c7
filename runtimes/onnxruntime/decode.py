"""The denoising loop over a lowered plan, which all streams follow: an instruction is one operation on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.lattice import BoolArray
from ttscompile.runtimes.instructions import Instructions

from .idle_steps import WORTH, IdleSteps
from .workspace import Workspace


def decode_first(work: Workspace, keep: BoolArray) -> None:
    """Step 0, which is dense in every plan, so that it need not wait for one.

    Computed residuals of the cells ``keep``, bool ``[K, blocks]``, go into the rollout cache.
    """
    work.begin()
    _run_dense(work, 0, keep)


def _run_dense(work: Workspace, k: int, keep: BoolArray) -> None:
    work.run_dense(k)
    for b in np.flatnonzero(keep[k]).tolist():
        np.copyto(work.entry(k * len(work.current) + b), work.current[b])
    work.advance(k)


def decode_rest(work: Workspace, lowered: Instructions, keep: BoolArray) -> None:
    """The steps after step 0, where all streams follow one plan; the sample is then ``work.sample[K % 2]``."""
    blocks = len(work.current)
    operands = _Operands(work, lowered)
    k, done, steps = 1, blocks, len(lowered.counts)
    while k < steps:
        count = lowered.counts[k]
        if work.idle is not None and lowered.idle[k] >= WORTH:
            k = _pass_idle(work, work.idle, operands, k)
            continue
        if count == blocks:
            _run_dense(work, k, keep)
        else:
            _run_some(work, operands, k, done, keep[k].tolist())
        k, done = k + 1, done + count


def _run_some(work: Workspace, operands: _Operands, k: int, done: int, kept: Sequence[bool]) -> None:
    """Step k, which computes some blocks, or none, after ``done`` cells; ``kept`` says whose residual is, by block."""
    lowered, hidden, current, blocks = operands.lowered, operands.hidden, operands.current, len(kept)
    count = lowered.counts[k]
    fresh = before = _flat(work.fresh, 0)  # the first operation takes the hidden state from there
    reached = 0
    for cell in lowered.cells[done : done + count]:
        b = cell - k * blocks
        if b != reached:
            operands.add(before)
        elif before is fresh:
            np.copyto(hidden, fresh)
        before, reached = hidden, b + 1
        work.run(k, b)
        residual = current[b]
        np.add(hidden, residual, hidden)
        if kept[b]:
            np.copyto(work.entry(cell), work.current[b])
    if reached != blocks:
        operands.add(before)
    work.advance(k)


def _pass_idle(work: Workspace, idle: IdleSteps, operands: _Operands, k: int) -> int:
    """Steps in a row without a computed block, from k on; the step that follows them."""
    lowered, total = operands.lowered, _flat(idle.total, 0)
    stop = k + lowered.idle[k]
    work.enter_idle(k)
    while k < stop:
        count = lowered.alike[k]
        np.copyto(total, operands.total(count))
        idle.prepare()
        work.run_idle(k, k + count)
        k += count
    work.leave_idle(stop)
    return stop


class _Operands:
    """What the instructions of one plan work on, with the axes of a residual made one."""

    def __init__(self, work: Workspace, lowered: Instructions) -> None:
        self.lowered = lowered
        self.hidden, self.current = _flat(work.hidden, 0), _flat(work.current, 1)
        self._table, self._sums = _flat(work.table, 1), _flat(work.sums(lowered.slots), 1)
        self._summed = self._table if lowered.table else self.current
        self._gaps, self._loads = iter(lowered.gaps), zip(lowered.load_rows, lowered.load_from, strict=True)
        self._entries = {cell: _flat(work.entry(cell), 0) for cell in np.flatnonzero(lowered.rollout).tolist()}

    def total(self, alike: int = 1) -> Array:
        """The sum of the next gaps, so many of which add the same one; it is made first if it is new."""
        slot, start, stop, loads = next(self._gaps)
        for _ in islice(self._gaps, alike - 1):
            pass
        total: Array = self._sums[slot]
        if start != stop:
            for row, source in islice(self._loads, loads):  # faster than numpy's indexing by arrays at any length
                self._table[row] = self.current[~source] if source < 0 else self._entries[source]
            np.add.reduce(self._summed[start:stop], axis=0, out=total)
        return total

    def add(self, before: Array) -> None:
        """The hidden state becomes ``before`` and the sum of the next gap."""
        np.add(before, self.total(), self.hidden)


def _flat(array: Array, keep: int) -> Array:
    """A view of the array with all axes after the first ``keep`` made one."""
    return array.reshape(*array.shape[:keep], math.prod(array.shape[keep:]))
