"""BAC: each block is computed where a dynamic programme on its own similarities says so, then updates bubble up.

Source: Ji et al., Block-wise Adaptive Caching for Accelerating Diffusion Policy, ICLR 2026 (arXiv 2506.13456).

1. Adaptive caching scheduler. Of a block's residual in dense calls, ``S[a, t]`` is the cosine similarity between steps
   a and t. Reusing a's residual at steps a..b scores ``sum S[a, t]``. Among all ways to place m computations, the first
   at step 0, the dynamic programme finds the one with the highest score.
2. Bubbling union. A feed-forward block that is refreshed on a stale stream is worse than a stale one. So the blocks
   whose residual changes most are computed wherever a feed-forward block at or after them is.

The paper computes every block m times. Here m is the largest that leaves the union within the budget, and the rest of
the budget goes to the blocks whose score gains most by one computation more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.task import Found, Task
from ttscompile.core.lattice import BoolArray, PlanArray, Source

from .dense import dense_steps, some_calls
from .fixed import best_of, fixed

Scores = npt.NDArray[np.float64]

DENSE_CALLS = 4
"""Dense calls whose similarities are averaged, if there is time; the paper takes one."""

BUBBLING = 5
"""Blocks that take over the updates of those after them."""

FEED_FORWARD = "feed_forward"


@fixed
def bac(task: Task) -> Found:
    """The schedule of the scheduler and the union."""
    model = task.runner.model
    calls, run = some_calls(task, DENSE_CALLS), task.runner
    found = [statistics(dense_residuals(run, run.select(calls, [i]))) for i in task.clock.in_time(range(calls.count))]
    similarity, change = (np.mean([one[part] for one in found], axis=0) for part in range(2))
    most = min(model.steps, task.budget // model.blocks + 1)
    schedules = [best_schedules(one, most) for one in similarity]
    followed = bubbling(change, [block.kind for block in run.view.manifest.blocks])
    counts = spend(schedules, followed, task.budget)
    computed = union([one[n - 1].computed for one, n in zip(schedules, counts, strict=True)], followed)
    plan: PlanArray = np.where(computed, Source.COMPUTE, Source.TIMESTEP).astype(np.int8)
    return best_of(task, [(plan, {"computations": counts, "bubbling": sorted(followed)})])


@dataclass(frozen=True)
class Schedule:
    """Where one block is computed.

    Attributes:
        computed: bool ``[K]``.
    """

    computed: BoolArray
    score: float


def best_schedules(similarity: Scores, most: int) -> list[Schedule]:
    """The schedules with the highest scores with 1, 2, ... ``most`` computations, the first at step 0.

    Args:
        similarity: ``[K, K]``, ``S[a, t]`` of one block.
        most: computations at most.
    """
    steps = len(similarity)
    sums = np.concatenate([np.zeros((steps, 1)), np.cumsum(similarity, 1)], 1)
    segment = sums - np.diagonal(sums)[:, None]  # [a, e]: a's residual is added at a..e-1
    segment[np.arange(steps)[:, None] >= np.arange(steps + 1)] = -np.inf
    best = segment[0]  # [e]: of everything before e, with as many computations as there were rounds
    origins: list[npt.NDArray[np.int64]] = []
    schedules = [_schedule(origins, steps, float(best[steps]))]
    for _ in range(most - 1):
        through = best[:steps, None] + segment  # [a, e]: the last computation at a
        origins.append(through.argmax(0))
        best = through.max(0)
        schedules.append(_schedule(origins, steps, float(best[steps])))
    return schedules


def _schedule(origins: Sequence[npt.NDArray[np.int64]], steps: int, score: float) -> Schedule:
    """Follow the last computations back from the end."""
    computed = np.zeros(steps, np.bool_)
    end = steps
    for row in reversed(origins):
        end = int(row[end])
        computed[end] = True
    computed[0] = True
    return Schedule(computed, score)


def bubbling(change: Scores, kinds: Sequence[str]) -> dict[int, list[int]]:
    """The blocks that change most -> the feed-forward blocks at or after each, whose updates it takes over.

    In a policy of unknown structure no block is called feed-forward; then any block counts as one.

    Args:
        change: ``[blocks]``, mean absolute difference of a block's residual between two steps.
        kinds: the kind of each block.
    """
    followed = [b for b, kind in enumerate(kinds) if kind == FEED_FORWARD] or list(range(len(kinds)))
    sources = np.argsort(-change, kind="stable")[:BUBBLING]
    return {int(b): [other for other in followed if other >= b] for b in sources}


def union(computed: Sequence[BoolArray], followed: Mapping[int, Sequence[int]]) -> BoolArray:
    """Cells ``[K, blocks]`` after the union, from each block's own ``[K]``."""
    cells = np.stack(computed, 1)
    own = cells.copy()
    for b, others in followed.items():
        cells[:, b] |= own[:, others].any(1)
    return cells


def spend(schedules: Sequence[Sequence[Schedule]], followed: Mapping[int, Sequence[int]], budget: int) -> list[int]:
    """Number of computations of each block before the union, such that there are at most ``budget`` after it."""

    def fits(counts: Sequence[int]) -> bool:
        cells = union([one[n - 1].computed for one, n in zip(schedules, counts, strict=True)], followed)
        return int(cells.sum()) <= budget

    blocks, most = len(schedules), len(schedules[0])
    even = next(m for m in range(most, 0, -1) if fits([m] * blocks))
    counts = [even] * blocks
    if even < most:
        gains = [one[even].score - one[even - 1].score for one in schedules]
        for b in np.argsort([-gain for gain in gains], kind="stable"):
            more = [n + int(i == b) for i, n in enumerate(counts)]
            if fits(more):
                counts = more
    return counts


def statistics(residuals: Sequence[Tensor]) -> tuple[Scores, Scores]:
    """How each block's residual changes over the steps of dense calls.

    Args:
        residuals: ``[N, K, size]`` a block.

    Returns:
        Cosine similarities ``[blocks, K, K]``, and mean absolute differences over all pairs of steps ``[blocks]``; both
        averaged over the calls.
    """
    similarity, change = [], []
    for rows in residuals:
        unit = torch.nn.functional.normalize(rows, dim=-1)
        similarity.append((unit @ unit.transpose(1, 2)).mean(0).cpu().double().numpy())
        change.append(float(torch.cdist(rows, rows, p=1).mean().cpu()) / rows.shape[-1])
    return np.stack(similarity), np.array(change)


def dense_residuals(runner: Runner, calls: Calls) -> list[Tensor]:
    """What each block adds at every step of dense calls: ``[N, K, size]`` a block."""
    kept: list[list[Tensor]] = [[] for _ in runner.axes]
    for _, residuals in dense_steps(runner, calls):
        for rows, residual, axis in zip(kept, residuals, runner.axes, strict=True):
            rows.append(residual.movedim(axis, 0).flatten(1))
    return [torch.stack(rows, 1) for rows in kept]
