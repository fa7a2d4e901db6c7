"""DBCache: the first blocks are computed at every step, and the others where what those add has changed enough.

Source: cache-dit's DBCache, which generalises ParaAttention's first-block cache. The change is relative to the last
step that was computed whole. The user says there how many blocks come first (``Fn``) and how many steps are computed
whole at the beginning, 8 by default; here the calls to learn from decide. ``Bn``, blocks computed at the end, is 0 as
it is there by default.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..calibration.task import Found, Task
from ..errors import CalibrationError
from .fixed import fixed
from .online import Criterion, online

FIRST = (1, 2, 3)
"""Blocks, not layers: a layer of a transformer decoder is three."""

WARMUP = (8, 1)

START = 0.5
"""A relative change to begin with; theirs are 0.05 to 0.24."""


@fixed
def dbcache(task: Task) -> Found:
    """The best of ``proposals``, with the threshold for the budget."""
    return online(task, proposals(task))


def proposals(task: Task) -> Sequence[tuple[Criterion, float]]:
    """For each number of first blocks and of warm-up steps that the budget has room for, a criterion."""
    steps, blocks = task.executor.model.steps, task.executor.model.blocks
    if blocks < 2:
        raise CalibrationError(
            "strategy 'dbcache' decides about the blocks after the first; the policy has one block. Take teacache."
        )
    found = []
    for always in FIRST:
        for warmup in WARMUP:
            least = always * steps + min(warmup, steps) * (blocks - always)
            if always < blocks and (least <= task.budget or (always, warmup) == (1, 1)):
                criterion = Criterion("dbcache", always, START, (1.0, 0.0), False, warmup, closes=False)
                found.append((criterion, START))
    return found
