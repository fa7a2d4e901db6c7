"""The denoising loop over lowered plans: all streams of a batch together, or each by its own instructions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from ttscompile.core.lattice import BoolArray
from ttscompile.runtimes.instructions import Instructions

from .idle_steps import WORTH, IdleSteps
from .sessions import Array
from .workspace import Workspace


def decode_first(work: Workspace, keep: BoolArray) -> None:
    """Step 0, which is dense in every plan, so that it need not wait for one.

    Args:
        work: observation and noise taken in.
        keep: bool ``[K, blocks]``; computed residuals that go into the rollout cache.
    """
    work.begin()
    _run_dense(work, 0, keep)


def _run_dense(work: Workspace, k: int, keep: BoolArray) -> None:
    work.run_dense(k)
    for b in np.flatnonzero(keep[k]).tolist():
        np.copyto(work.rollout.entry(k * len(work.current) + b), work.current[b])
    work.advance(k)


def decode_rest(work: Workspace, lowered: Sequence[Instructions], keep: BoolArray) -> None:
    """The steps after step 0; the sample is then ``work.sample[K % 2]``."""
    if all(one is lowered[0] for one in lowered):
        _together(work, lowered[0], keep)
    else:
        _apart(work, lowered, keep)


def _together(work: Workspace, lowered: Instructions, keep: BoolArray) -> None:
    """All streams follow one plan: every instruction is one operation on the whole batch."""
    blocks = len(work.current)
    entries = {cell: work.rollout.entry(cell) for cell in np.flatnonzero(lowered.rollout).tolist()}
    operands = _Operands(lowered, work.stream, work.current, work.table, work.sums(lowered.slots), entries)
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
            np.copyto(work.rollout.entry(cell), work.current[b])
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


# C901, PLR0912: its locals are the state of the loop
def _apart(work: Workspace, lowered: Sequence[Instructions], keep: BoolArray) -> None:  # noqa: C901, PLR0912
    """Every stream follows its own plan; a block that several compute in a step runs once, on these."""
    blocks, everyone = len(work.current), work.streams
    room = work.sums(max(one.slots for one in lowered))
    operands = [_Operands.of_stream(work, s, one, room) for s, one in enumerate(lowered)]
    takers: list[list[list[int]]] = [[[] for _ in range(blocks)] for _ in lowered[0].counts]
    for k, b, s in np.argwhere(np.stack([one.computed for one in lowered], axis=2)).tolist():
        takers[k][b].append(s)
    for k, step in enumerate(takers[1:], start=1):
        whole = step[0] if all(some == step[0] for some in step) else []  # these compute all blocks, the others none
        if len(whole) < everyone:
            np.copyto(work.stream, work.fresh)
        if whole:
            _run_dense_apart(work, [operands[s] for s in whole], whole, k, keep)
        reached = [blocks if s in whole else 0 for s in range(everyone)]
        for b, some in enumerate([] if whole else step):
            if not some:
                continue
            for s in some:
                if reached[s] != b:
                    operands[s].add(operands[s].hidden)
                reached[s] = b + 1
            if len(some) == everyone:
                work.run(k, b)
            else:
                residuals = work.run_some(k, b, some)
                for s, residual in zip(some, residuals, strict=True):
                    np.copyto(operands[s].current[b], residual.reshape(operands[s].current[b].shape))
            for s in some:
                hidden, residual = operands[s].hidden, operands[s].current[b]
                np.add(hidden, residual, hidden)
                if keep[k, b]:
                    np.copyto(work.rollout.of_stream(k * blocks + b, s), residual.reshape(operands[s].shape))
        for one, b in zip(operands, reached, strict=True):
            if b != blocks:
                one.add(one.hidden)
        work.advance(k)


def _run_dense_apart(
    work: Workspace, operands: Sequence[_Operands], streams: Sequence[int], k: int, keep: BoolArray
) -> None:
    """All blocks at step k for these streams, all of the batch or some."""
    if len(streams) == work.streams:
        work.run_dense(k)
    else:
        after, *residuals = work.run_dense_some(k, streams)
        for i, one in enumerate(operands):
            np.copyto(one.hidden, after[i].reshape(one.hidden.shape))
            for own, residual in zip(one.current, residuals, strict=True):
                np.copyto(own, residual[i].reshape(own.shape))
    for b in np.flatnonzero(keep[k]).tolist():
        for s, one in zip(streams, operands, strict=True):
            np.copyto(work.rollout.of_stream(k * len(one.current) + b, s), one.current[b].reshape(one.shape))


class _Operands:
    """What the instructions of one plan work on: the whole batch, or one stream of it, as views.

    ``hidden`` is the residual stream, ``current`` and ``table`` are ``[blocks, *hidden]``, ``sums`` are ``[slots,
    *hidden]``, and ``entries`` those of the rollout cache that the plan reads, by flat index.
    """

    def __init__(
        self, lowered: Instructions, hidden: Array, current: Array, table: Array, sums: Array, entries: dict[int, Array]
    ) -> None:
        self.lowered, self.shape = lowered, hidden.shape
        self.hidden, self.current = _flat(hidden, 0), _flat(current, 1)
        self._table, self._sums = _flat(table, 1), _flat(sums, 1)
        self._summed = self._table if lowered.table else self.current
        self._gaps, self._loads = iter(lowered.gaps), zip(lowered.load_rows, lowered.load_from, strict=True)
        self._entries = {cell: _flat(entry, 0) for cell, entry in entries.items()}

    @classmethod
    def of_stream(cls, work: Workspace, s: int, lowered: Instructions, sums: Array) -> _Operands:
        """Those of one stream of the batch."""
        axis = work.axis
        current, table, sums = (np.moveaxis(array, axis + 1, 1)[:, s] for array in (work.current, work.table, sums))
        entries = {cell: work.rollout.of_stream(cell, s) for cell in np.flatnonzero(lowered.rollout).tolist()}
        return cls(lowered, np.moveaxis(work.stream, axis, 0)[s], current, table, sums, entries)

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
    """The array with all axes after the first ``keep`` made one, where that is a view; else as it is."""
    if not array.size:
        return array
    inner = array[0] if keep else array
    return array.reshape(*array.shape[:keep], -1) if inner.flags.c_contiguous else array
