"""The denoising loop over lowered plans: all streams of a batch together, or each by its own instructions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ttscompile.lattice import BoolArray

from .lowering import Add, Lowered
from .onnxruntime_sessions import Array
from .workspace import Workspace


def decode_first(work: Workspace, keep: BoolArray) -> None:
    """Step 0, which is dense in every plan, so that it need not wait for one.

    Args:
        work: observation and noise taken in.
        keep: bool ``[K, blocks]``; computed residuals that go into the rollout cache.
    """
    work.begin()
    stream = work.stream
    np.copyto(stream, work.fresh)
    for b, kept in enumerate(keep[0].tolist()):
        work.run(0, b)
        residual = work.current[b]
        np.add(stream, residual, stream)
        if kept:
            np.copyto(work.rollout.entry(b), residual)
    work.advance(0)


def decode_rest(work: Workspace, lowered: Sequence[Lowered], keep: BoolArray) -> None:
    """The steps after step 0; the sample is then ``work.sample[K % 2]``.

    Args:
        work: after ``decode_first``.
        lowered: instructions of each stream.
        keep: as above.
    """
    if all(one is lowered[0] for one in lowered):
        _together(work, lowered[0], keep)
    else:
        _apart(work, lowered, keep)


def _together(work: Workspace, lowered: Lowered, keep: BoolArray) -> None:
    """All streams follow one plan: every instruction is one operation on the whole batch."""
    blocks = len(work.current)
    entries = {cell: work.rollout.entry(cell) for cell in np.flatnonzero(lowered.rollout).tolist()}
    lane = _Lane(lowered, work.stream, work.current, work.table, work.sums(lowered.slots), entries)
    gaps, stream, current, run = iter(lowered.gaps[blocks + 1 :]), lane.stream, lane.current, work.run
    fresh = _flat(work.fresh, 0)
    kept = keep.reshape(-1).tolist()
    cells = iter(lowered.cells[blocks:])
    for k, count in enumerate(lowered.counts[1:], start=1):
        before = fresh  # the first operation of a step takes the stream from there
        for _ in range(count):
            gap, cell = next(gaps), next(cells)
            if gap is not None:
                lane.add(gap, before)
            elif before is fresh:
                np.copyto(stream, fresh)
            before = stream
            b = cell - k * blocks
            run(k, b)
            residual = current[b]
            np.add(stream, residual, stream)
            if kept[cell]:
                np.copyto(work.rollout.entry(cell), work.current[b])
        gap = next(gaps)
        if gap is not None:
            lane.add(gap, before)
        work.advance(k)


def _apart(work: Workspace, lowered: Sequence[Lowered], keep: BoolArray) -> None:
    """Every stream follows its own plan; a block that several compute in a step runs once, on these."""
    blocks, everyone = len(work.current), work.streams
    room = work.sums(max(one.slots for one in lowered))
    lanes = [_Lane.of_stream(work, s, one, room) for s, one in enumerate(lowered)]
    gaps = [iter(one.gaps[blocks + 1 :]) for one in lowered]
    takers: list[list[list[int]]] = [[[] for _ in range(blocks)] for _ in lowered[0].counts]
    for k, b, s in np.argwhere(np.stack([one.computed for one in lowered], axis=2)).tolist():
        takers[k][b].append(s)
    for k, step in enumerate(takers[1:], start=1):
        np.copyto(work.stream, work.fresh)
        for b, some in enumerate(step):
            if not some:
                continue
            for s in some:
                lanes[s].add_next(next(gaps[s]))
            if len(some) == everyone:
                work.run(k, b)
            else:
                residuals = work.run_some(k, b, some)
                for s, residual in zip(some, residuals, strict=True):
                    np.copyto(lanes[s].current[b], residual.reshape(lanes[s].current[b].shape))
            for s in some:
                stream, residual = lanes[s].stream, lanes[s].current[b]
                np.add(stream, residual, stream)
                if keep[k, b]:
                    np.copyto(work.rollout.of_stream(k * blocks + b, s), residual.reshape(lanes[s].shape))
        for lane, rest in zip(lanes, gaps, strict=True):
            lane.add_next(next(rest))
        work.advance(k)


class _Lane:
    """What the instructions of one plan work on: the whole batch, or one stream of it, as views.

    Args:
        lowered: the instructions.
        stream: ``[...]``.
        current: ``[blocks, ...]``.
        table: ``[blocks, ...]``.
        sums: ``[slots, ...]``.
        entries: of the rollout cache, those that the plan reads, by flat index.
    """

    def __init__(
        self, lowered: Lowered, stream: Array, current: Array, table: Array, sums: Array, entries: dict[int, Array]
    ) -> None:
        self.shape = stream.shape
        self.stream, self.current = _flat(stream, 0), _flat(current, 1)
        self._table, self._sums = _flat(table, 1), _flat(sums, 1)
        self._summed = self._table if lowered.table else self.current
        self._rows, self._from = lowered.load_rows, lowered.load_from
        self._entries = {cell: _flat(entry, 0) for cell, entry in entries.items()}

    @classmethod
    def of_stream(cls, work: Workspace, s: int, lowered: Lowered, sums: Array) -> _Lane:
        """The lane of one stream of the batch."""
        axis = work.axis
        current, table, sums = (np.moveaxis(array, axis + 1, 1)[:, s] for array in (work.current, work.table, sums))
        entries = {cell: work.rollout.of_stream(cell, s) for cell in np.flatnonzero(lowered.rollout).tolist()}
        return cls(lowered, np.moveaxis(work.stream, axis, 0)[s], current, table, sums, entries)

    def add(self, gap: Add, before: Array) -> None:
        """The stream becomes ``before`` and a sum, which is made first if it is new."""
        slot, start, stop, due = gap
        total = self._sums[slot]
        if start != stop:
            for i in range(*due):  # faster than numpy's indexing by arrays at any length
                source = self._from[i]
                self._table[self._rows[i]] = self.current[~source] if source < 0 else self._entries[source]
            np.add.reduce(self._summed[start:stop], axis=0, out=total)
        np.add(before, total, self.stream)

    def add_next(self, gap: Add | None) -> None:
        """``add`` to the stream, if any block is reused in this gap."""
        if gap is not None:
            self.add(gap, self.stream)


def _flat(array: Array, keep: int) -> Array:
    """The array with all axes after the first ``keep`` made one, where that is a view; else as it is."""
    if not array.size:
        return array
    inner = array[0] if keep else array
    return array.reshape(*array.shape[:keep], -1) if inner.flags.c_contiguous else array
