"""From a plan to a short list of instructions: run this block; add this sum of residuals.

Every reused cell is resolved to the computed residual that it adds (``lattice.origins``), so that a run of reused
blocks between two computed ones is one addition of one sum. A sum that adds the same residuals as an earlier one of
the call is not made again.

    plan            C T T C F T T      instructions   run 0, add sum{(0,1),(0,2)}, run 3, add sum{(1,3),(0,5),(0,6)}

Sums are taken over rows of a table that holds, for each block, the residual that this block adds at the moment. In a
run of reused blocks these rows are neighbours, so the sum is one pass over contiguous memory; and since most cells add
what they added the step before, few rows have to be loaded. The result differs from adding block by block in the order
of the summation only.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ttscompile.lattice import UNWRITTEN, BoolArray, IntArray, PlanArray, Source, origins, require_legal


class Segment(NamedTuple):
    """How to make one sum: of the rows ``start..stop`` of the table, after loading those that changed.

    Attributes:
        start: first block of the run.
        stop: one past the last block.
        load: first entry of ``Lowered.load_blocks`` and ``load_cells`` that belongs to it.
        load_stop: one past the last.
    """

    start: int
    stop: int
    load: int
    load_stop: int


class Add(NamedTuple):
    """Add a sum to the stream, after making it if it is new.

    Attributes:
        slot: where the sum is kept while it is needed.
        make: how to make it; None if it is in its slot already.
    """

    slot: int
    make: Segment | None


class Step(NamedTuple):
    """One step: add ``gaps[0]``, run ``blocks[0]``, add ``gaps[1]``, ..., run ``blocks[-1]``, add ``gaps[-1]``.

    Attributes:
        blocks: computed blocks in order.
        gaps: one more than blocks; None where no block is reused in between.
    """

    blocks: tuple[int, ...]
    gaps: tuple[Add | None, ...]


@dataclass(frozen=True)
class Lowered:
    """The instructions of one stream's plan.

    Attributes:
        steps: K of them.
        slots: how many sums have to be kept at a time.
        segments: how many sums are made in the call.
        load_blocks: rows of the table that are loaded, in order, int64 ``[n]``.
        load_cells: the residual that each of them takes, as a flat index ``k * blocks + b``: of this call, or where
            the plan says ROLLOUT of an earlier one.
        computed: bool ``[K, blocks]``.
        rollout: bool ``[K, blocks]``; entries of the rollout cache that the plan reads, so that it is legal in an
            episode that has written them.
    """

    steps: tuple[Step, ...]
    slots: int
    segments: int
    load_blocks: IntArray
    load_cells: IntArray
    computed: BoolArray
    rollout: BoolArray


def lower_plan(plan: PlanArray, groups: Sequence[int]) -> Lowered:
    """Lower the plan of one stream.

    Args:
        plan: int8 ``[K, blocks]``.
        groups: FORWARD group of each block.

    Raises:
        IllegalPlanError: it reads a residual that was never computed; ROLLOUT reads are taken to be written.
    """
    steps, blocks = plan.shape
    resolved = origins(plan, groups)
    computed = plan == Source.COMPUTE
    if (resolved.cell == UNWRITTEN).any() or not computed[0].all():
        require_legal(plan[None], groups, np.ones((1, steps, blocks), dtype=np.bool_))

    # A gap is numbered by its step and by how many blocks are computed before it in the step.
    gap = np.arange(steps)[:, None] * (blocks + 1) + np.cumsum(computed, axis=1)
    where = np.flatnonzero(~computed)
    gaps, cells = gap.reshape(-1)[where], resolved.cell.reshape(-1)[where]
    starts = np.flatnonzero(np.diff(gaps, prepend=-1))
    bounds = [*starts.tolist(), len(where)]
    first = _first_alike(np.sort(gaps * plan.size + cells) % plan.size, bounds)

    made = np.repeat(np.asarray(first) == np.arange(len(first)), np.diff(bounds))
    loaded = _changed(where % blocks, cells, made)
    slot_of, slots = _slots(first)
    load = np.concatenate([[0], np.cumsum(loaded)])[bounds].tolist()
    begins = (where[starts] % blocks).tolist()
    adds: dict[int, Add] = {}
    for n, number in enumerate(gaps[starts].tolist()):
        segment = None
        if first[n] == n:
            segment = Segment(begins[n], begins[n] + bounds[n + 1] - bounds[n], load[n], load[n + 1])
        adds[number] = Add(slot_of[first[n]], segment)
    return Lowered(
        steps=_steps(computed, adds),
        slots=slots,
        segments=len(set(first)),
        load_blocks=where[loaded] % blocks,
        load_cells=cells[loaded],
        computed=computed,
        rollout=resolved.rollout,
    )


def _steps(computed: BoolArray, adds: Mapping[int, Add]) -> tuple[Step, ...]:
    """Blocks and gaps of every step; ``adds`` by number of the gap."""
    width = computed.shape[1] + 1
    run = np.nonzero(computed)[1].tolist()
    steps, begin = [], 0
    for k, count in enumerate(computed.sum(axis=1).tolist()):
        gaps = tuple([adds.get(number) for number in range(k * width, k * width + count + 1)])
        steps.append(Step(tuple(run[begin : begin + count]), gaps))
        begin += count
    return tuple(steps)


def _first_alike(keys: IntArray, bounds: list[int]) -> list[int]:
    """For each gap the first gap that adds the same residuals, which may be itself.

    Args:
        keys: residuals of all gaps, sorted within each gap.
        bounds: where the gaps begin, and the end.
    """
    content, size = keys.tobytes(), keys.itemsize
    seen: dict[bytes, int] = {}
    return [seen.setdefault(content[size * i : size * j], n) for n, (i, j) in enumerate(pairwise(bounds))]


def _slots(first: list[int]) -> tuple[dict[int, int], int]:
    """A place for every sum, given to another one after its last use.

    Args:
        first: for each gap, the gap that makes its sum.

    Returns:
        Place by the gap that makes the sum, and how many places there are.
    """
    last_use = {maker: n for n, maker in enumerate(first)}
    of: dict[int, int] = {}
    free: list[int] = []
    count = 0
    for n, maker in enumerate(first):
        if maker == n:
            if not free:
                free.append(count)
                count += 1
            of[n] = free.pop()
        if last_use[maker] == n:
            free.append(of[maker])
    return of, count


def _changed(block: IntArray, cells: IntArray, made: BoolArray) -> BoolArray:
    """Reused cells of sums that are made, whose residual is not the one that the table's row holds already.

    Args:
        block: of each reused cell, in order of execution.
        cells: residual that each adds.
        made: whether its sum is made; the rows of the others are not looked at.
    """
    changed = np.zeros_like(made)
    index = np.flatnonzero(made)
    order = index[np.argsort(block[index], kind="stable")]
    new_block = np.diff(block[order], prepend=-1) != 0
    new_cell = np.diff(cells[order], prepend=-1) != 0
    changed[order] = new_block | new_cell
    return changed


class LoweringCache:
    """The last plans that were lowered: schedules are lowered once, the pruner's plans when they change.

    Args:
        groups: FORWARD group of each block.
        capacity: plans to keep.
    """

    def __init__(self, groups: Sequence[int], capacity: int = 64) -> None:
        self._groups = tuple(groups)
        self._capacity = capacity
        self._plans: OrderedDict[bytes, Lowered] = OrderedDict()

    def lower(self, plan: PlanArray) -> Lowered:
        """``lower_plan``, remembered.

        Args:
            plan: int8 ``[K, blocks]``, contiguous.

        Raises:
            IllegalPlanError: see ``lower_plan``.
        """
        key = plan.tobytes()
        found = self._plans.get(key)
        if found is None:
            found = self._plans[key] = lower_plan(plan, self._groups)
            if len(self._plans) > self._capacity:
                self._plans.popitem(last=False)
        else:
            self._plans.move_to_end(key)
        return found
