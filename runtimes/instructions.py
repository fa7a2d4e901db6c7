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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ttscompile.core.lattice import UNWRITTEN, BoolArray, PlanArray, Source, origins, require_legal

Add = tuple[int, int, int, int]
"""Add a sum to the residual stream, after making it if it is new: its slot, kept while it is needed; the first row
that it sums; one past the last, which is the first if the sum is in its slot already; and how many of the entries of
``Instructions.load_rows`` and ``load_from`` that are left to load before it is made."""

Cells = npt.NDArray[np.int32]
Positions = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Instructions:
    """The instructions of one stream's plan.

    Attributes:
        counts: computed blocks of each step, K of them.
        cells: computed cells in order of execution, flat indices ``k * blocks + b``.
        gaps: runs of reused blocks within a step, of all steps in order.
        slots: how many sums have to be kept at a time.
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
    gaps: tuple[Add, ...]
    slots: int
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


def instructions_of(plan: PlanArray, groups: Sequence[int]) -> Instructions:
    """What executes the plan of one stream, int8 ``[K, blocks]``, with the FORWARD group of each block.

    Raises:
        IllegalPlanError: it reads a residual that was never computed; ROLLOUT reads are taken to be written.
    """
    steps, blocks = plan.shape
    resolved = origins(plan, groups)
    computed = plan == Source.COMPUTE.value
    if not computed[0].all():  # after it TIMESTEP and FORWARD always find a residual
        require_legal(plan[None], groups, np.ones((1, steps, blocks), dtype=np.bool_))

    # A gap lies between two ends in the flat order; a column after the last block ends it as computed blocks do.
    width = blocks + 1
    cells, is_end = np.full((steps, width), UNWRITTEN, np.int32), np.ones((steps, width), np.bool_)
    cells[:, :blocks], is_end[:, :blocks] = resolved.cell, computed
    ends = np.flatnonzero(is_end)
    lengths = ends[1:] - ends[:-1] - 1
    some = np.flatnonzero(lengths)
    lengths, stops = lengths[some], ends[some + 1]
    starts = stops - lengths
    maker = _makers(cells, starts, stops)
    slot, slots = _slots(maker, len(starts))
    made = lengths.copy()  # rows that are summed
    made[list(maker)] = 0

    table = bool(resolved.rollout.any() or (plan == Source.FORWARD.value).any())
    loads, load_rows, load_from = [0] * len(starts), list[int](), list[int]()
    if table:
        of_gap = np.repeat(np.arange(len(made)), made)
        at = np.arange(len(of_gap)) + (starts + made - np.cumsum(made))[of_gap]
        load = np.flatnonzero(_changes(cells, at))
        loads, at = np.bincount(of_gap[load], minlength=len(made)).tolist(), at[load]
        step = at // width
        own, adds = at - step, cells.reshape(-1)[at]
        load_rows = (own - step * blocks).tolist()
        load_from = np.where(adds == own, adds, ~(adds % blocks)).tolist()  # ROLLOUT alone resolves to the cell itself
    rows = starts % width

    # From the last step to the first; a gap of all blocks is a step without a computed one.
    idle, alike, total = [0] * (steps + 1), [0] * (steps + 1), [-1] * (steps + 1)
    for gap in np.flatnonzero(lengths == blocks)[::-1].tolist():
        k = int(starts[gap]) // width
        total[k] = maker.get(gap, gap)
        idle[k] = idle[k + 1] + 1
        alike[k] = alike[k + 1] + 1 if total[k] == total[k + 1] else 1
    return Instructions(
        counts=tuple(computed.sum(axis=1).tolist()),
        cells=tuple(np.flatnonzero(computed).tolist()),
        gaps=tuple(zip(slot, rows.tolist(), (rows + made).tolist(), loads, strict=True)),
        slots=slots,
        table=table,
        load_rows=tuple(load_rows),
        load_from=tuple(load_from),
        idle=tuple(idle[:steps]),
        alike=tuple(alike[:steps]),
        computed=computed,
        rollout=resolved.rollout,
    )


def by_plan(plans: Sequence[Instructions]) -> dict[Instructions, list[int]]:
    """The streams of a batch by the plan that they follow: those of one plan go through the loop together."""
    streams: dict[Instructions, list[int]] = {}
    for s, plan in enumerate(plans):
        streams.setdefault(plan, []).append(s)
    return streams


def _makers(cells: Cells, starts: Positions, stops: Positions) -> dict[int, int]:
    """For each gap that adds the same residuals as an earlier one, the first such gap.

    With FORWARD other blocks may add them; those of one residual or in the same order are found, nearly all. ``cells``
    are ``[K, blocks + 1]``, the residual of each; gaps go from ``starts`` to ``stops``, flat.
    """
    total = np.cumsum(cells)
    hashed = (total[stops - 1] - total[starts - 1]) & 8191  # most are the only ones of theirs, and need no comparison
    likely = np.flatnonzero(np.bincount(hashed)[hashed] > 1)
    content, size, seen = cells.tobytes(), cells.itemsize, dict[bytes, int]()
    bounds = zip(likely.tolist(), (size * starts[likely]).tolist(), (size * stops[likely]).tolist(), strict=True)
    first = {gap: seen.setdefault(content[i:j], gap) for gap, i, j in bounds}
    return {gap: maker for gap, maker in first.items() if maker != gap}


def _slots(maker: dict[int, int], gaps: int) -> tuple[list[int], int]:
    """The place of each gap's sum, given to another one after its last use, and how many places there are.

    The last one is of the sums that are used once.
    """
    last_use = {first: gap for gap, first in maker.items()}
    until: list[int] = []  # of each place, the last use of the sum that it holds
    place: dict[int, int] = {}
    for first in sorted(last_use):
        place[first] = next((i for i, last in enumerate(until) if last < first), len(until))
        until[place[first] : place[first] + 1] = [last_use[first]]
    of = [len(until)] * gaps
    for gap, first in maker.items():
        of[gap] = of[first] = place[first]
    return of, len(until) + (len(place) + len(maker) < gaps)


def _changes(cells: Cells, made: Positions) -> BoolArray:
    """Of cells in sums that are made, flat and in order, whether the table's row holds another residual than theirs."""
    flat, last = cells.reshape(-1), np.full(cells.shape, -1, np.int32)  # -1: the last column's, which is UNWRITTEN
    last.reshape(-1)[made] = made
    held = np.maximum.accumulate(last, axis=0).reshape(-1)[made - cells.shape[1]]
    changed: BoolArray = flat[held] != flat[made]
    return changed
