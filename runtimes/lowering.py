"""From a plan to a short list of instructions: run this block; add this sum of residuals.

Every reused cell is resolved to the computed residual that it adds (``lattice.origins``), so that a run of reused
blocks between two computed ones, a gap, is one addition of one sum. A sum that adds the same residuals as an earlier
one of the call is not made again.

    plan            C T T C F T T      instructions   run 0, add sum{(0,1),(0,2)}, run 3, add sum{(1,3),(0,5),(0,6)}

What TIMESTEP and FORWARD read is always the last residual that some block computed in this call, so one row a block
holds all of it. A plan of TIMESTEP alone sums these rows as they are: the blocks of a gap are neighbours, so a sum is
one pass over contiguous memory. Other plans sum over a second table, which holds what each block adds at the moment;
since most cells add what they added the step before, few of its rows have to be loaded. The result differs from adding
block by block in the order of the summation only.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import NamedTuple

import numpy as np

from ttscompile.lattice import UNWRITTEN, BoolArray, IntArray, PlanArray, Source, origins, require_legal


class Add(NamedTuple):
    """Add a sum to the stream, after making it if it is new.

    Attributes:
        slot: where the sum is kept while it is needed.
        start: first row that it sums.
        stop: one past the last; ``start`` if the sum is in its slot already.
        due: entries of ``Lowered.load_rows`` and ``load_from`` to load before it is made: first, and one past the last.
    """

    slot: int
    start: int
    stop: int
    due: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Lowered:
    """The instructions of one stream's plan.

    A step with n computed blocks has n + 1 gaps: one before each of them, and one after the last.

    Attributes:
        counts: computed blocks of each step, K of them.
        cells: computed cells in order of execution, flat indices ``k * blocks + b``.
        gaps: of all steps in order; None where no block is reused in between.
        slots: how many sums have to be kept at a time.
        segments: how many sums are made in the call.
        table: whether sums are over the table, and not over the last computed residuals as they are.
        load_rows: rows of the table that are loaded, in order.
        load_from: what each of them takes: an entry of the rollout cache by its flat index, or ``~b`` for the last
            residual that block b computed in this call.
        idle: for each step, how many steps from it on have no computed block; 0 if it has one.
        alike: for each step without a computed block, how many such steps from it on add the same sum.
        computed: bool ``[K, blocks]``.
        rollout: bool ``[K, blocks]``; entries of the rollout cache that the plan reads, so that it is legal in an
            episode that has written them.
    """

    counts: tuple[int, ...]
    cells: tuple[int, ...]
    gaps: tuple[Add | None, ...]
    slots: int
    segments: int
    table: bool
    load_rows: tuple[int, ...]
    load_from: tuple[int, ...]
    idle: tuple[int, ...]
    alike: tuple[int, ...]
    computed: BoolArray
    rollout: BoolArray

    @property
    def partial(self) -> bool:
        """Whether a step computes some of its blocks, and not all of them."""
        return any(0 < count < self.computed.shape[1] for count in self.counts)


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
    if not computed[0].all() or resolved.cell.min() == UNWRITTEN:
        require_legal(plan[None], groups, np.ones((1, steps, blocks), dtype=np.bool_))

    # A gap is a run of reused cells within a step: neighbours in the flat order, too.
    begins, ends = ~computed, ~computed
    begins[:, 1:] &= computed[:, :-1]
    ends[:, :-1] &= computed[:, 1:]
    starts, stops = np.flatnonzero(begins), np.flatnonzero(ends) + 1
    borrows = bool((plan == Source.FORWARD).any())
    cells = resolved.cell.reshape(-1)
    first = _first_alike(_in_order(cells, begins | computed) if borrows else cells, starts, stops)
    new = first == np.arange(len(first))
    slot, slots = _slots(first.tolist())

    table = borrows or bool(resolved.rollout.any())
    loaded = load = load_stop = np.zeros(0, dtype=np.int64)
    if table:
        loaded = _changed(resolved.cell, starts[new], stops[new])
        load = np.searchsorted(loaded, starts)
        load_stop = np.where(new, np.searchsorted(loaded, stops), load)
    rows = starts % blocks
    stop = np.where(new, rows + stops - starts, rows)
    due = zip(load.tolist(), load_stop.tolist(), strict=True) if table else repeat((0, 0))
    adds = map(Add._make, zip(slot, rows.tolist(), stop.tolist(), due, strict=False))
    done = np.cumsum(computed)
    gaps: list[Add | None] = [None] * (steps + int(done[-1]))
    for position, add in zip((done[starts] + starts // blocks).tolist(), adds, strict=True):
        gaps[position] = add
    idle = ~computed.any(axis=1)
    maker = np.full(steps, -1)
    maker[idle] = first[np.searchsorted(starts, np.flatnonzero(idle) * blocks)]
    joined, same = np.zeros((2, steps), np.bool_)
    joined[:-1] = idle[:-1] & idle[1:]
    same[:-1] = joined[:-1] & (maker[:-1] == maker[1:])
    source = np.where(resolved.rollout.reshape(-1)[loaded], cells[loaded], ~(cells[loaded] % blocks))
    return Lowered(
        counts=tuple(computed.sum(axis=1).tolist()),
        cells=tuple(np.flatnonzero(computed).tolist()),
        gaps=tuple(gaps),
        slots=slots,
        segments=int(np.count_nonzero(new)),
        table=table,
        load_rows=tuple((loaded % blocks).tolist()),
        load_from=tuple(source.tolist()),
        idle=tuple((_ahead(joined) * idle).tolist()),
        alike=tuple((_ahead(same) * idle).tolist()),
        computed=computed,
        rollout=resolved.rollout,
    )


def _ahead(joined: BoolArray) -> IntArray:
    """For each element how many from it on belong together; ``joined`` says it of an element and the next one."""
    ends, each = np.flatnonzero(~joined), np.arange(len(joined))
    length: IntArray = ends[np.searchsorted(ends, each)] - each + 1
    return length


def _in_order(cells: IntArray, begins: BoolArray) -> IntArray:
    """The residuals sorted within each gap, so that gaps which add the same ones hold the same numbers.

    Only FORWARD needs it: without it a residual is of the block that adds it, and blocks are in order.

    Args:
        cells: residual of every cell, flat.
        begins: cells at which a gap begins, and computed cells.
    """
    gap: IntArray = np.cumsum(begins)
    return np.sort(gap * len(cells) + cells) % len(cells)


def _first_alike(keys: IntArray, starts: IntArray, stops: IntArray) -> IntArray:
    """For each gap the first gap that adds the same residuals, which may be itself.

    Args:
        keys: residual of every cell, flat.
        starts: where the gaps begin.
        stops: where they end.
    """
    content, seen = keys.tobytes(), dict[bytes, int]()
    bounds = zip((keys.itemsize * starts).tolist(), (keys.itemsize * stops).tolist(), strict=True)
    return np.array([seen.setdefault(content[i:j], n) for n, (i, j) in enumerate(bounds)], dtype=np.int64)


def _slots(first: list[int]) -> tuple[list[int], int]:
    """A place for every sum, given to another one after its last use.

    Args:
        first: for each gap, the gap that makes its sum.

    Returns:
        Place of each gap's sum, and how many places there are.
    """
    last_use = {maker: n for n, maker in enumerate(first)}
    of: list[int] = []
    free: list[int] = []
    count = 0
    for n, maker in enumerate(first):
        if maker != n:
            of.append(of[maker])
        elif free:
            of.append(free.pop())
        else:
            of.append(count)
            count += 1
        if last_use[maker] == n:
            free.append(of[n])
    return of, count


def _changed(cells: IntArray, starts: IntArray, stops: IntArray) -> IntArray:
    """Reused cells of sums that are made, whose residual is not the one that the table's row holds already.

    Args:
        cells: residual of every cell, ``[K, blocks]``.
        starts: where the gaps begin whose sums are made; the cells of the others are not looked at.
        stops: where they end.

    Returns:
        Flat indices, in order.
    """
    steps, blocks = cells.shape
    edges = np.zeros(cells.size + 1, dtype=np.int64)
    edges[starts] = 1
    edges[stops] -= 1
    made = np.cumsum(edges[:-1]).reshape(steps, blocks)
    by_block = np.flatnonzero(made.T)  # row after row of the table, each in order of time
    held = cells.T.reshape(-1)[by_block]
    changed = np.ones(len(by_block), dtype=np.bool_)
    changed[1:] = (held[1:] != held[:-1]) | (by_block[1:] // steps != by_block[:-1] // steps)
    taken = by_block[changed]
    return np.sort(taken % steps * blocks + taken // steps)


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
