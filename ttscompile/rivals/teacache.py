"""TeaCache: the whole stack is skipped until the accumulated, estimated change of its output is large enough.

Source: Liu et al., Timestep Embedding Tells: It's Time to Cache for Video Diffusion Model, CVPR 2025 (arXiv
2411.19108). What is cheap to know at each step is the input of the first block; a polynomial of degree 4, fitted on
dense calls, turns its relative change from the step before into that of the output. First and last step are always
computed. The input is modulated by the timestep there; here it is the residual stream after the stem.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..calibration.calls import Calls
from ..calibration.execute import Executor
from ..calibration.task import Array, Found, Task
from .fixed import fixed
from .online import Criterion, online, relative_change

DEGREE = 4

DENSE_CALLS = 8
"""Calls that the polynomial is fitted on."""


@fixed
def teacache(task: Task) -> Found:
    """The criterion with the polynomial of this policy, and the threshold for the budget."""
    return online(task, proposal(task))


def proposal(task: Task) -> Sequence[tuple[Criterion, float]]:
    """The criterion, and a threshold to begin with."""
    calls = task.some_calls(DENSE_CALLS)
    before, after = dense_changes(task.executor, calls)
    # A policy of fewer steps than coefficients has fewer pairs to fit.
    degree = max(0, min(DEGREE, len(np.unique(before)) - 1))
    polynomial = tuple(float(c) for c in np.linalg.lstsq(np.vander(before, degree + 1), after)[0])
    total = float(np.maximum(np.polyval(polynomial, before), 0).sum()) / calls.count
    start = max(total / max(1, task.budget // task.executor.model.blocks), 1e-3)
    return [(Criterion("teacache", 0, start, polynomial, accumulates=True, warmup=1, closes=True), start)]


def dense_changes(executor: Executor, calls: Calls) -> tuple[Array, Array]:
    """Relative changes from step to step in dense calls: of the first block's input, and of the last one's output.

    Returns:
        Two arrays ``[(K - 1) * N]``.
    """
    seen = []
    for stem, residuals in executor.dense_steps(calls):
        seen.append([value.movedim(executor.axes[0], 0).cpu().numpy() for value in (stem, sum(residuals, stem))])
    changes = [[relative_change(b, a) for a, b in zip(*pair, strict=True)] for pair in pairwise(seen)]
    before, after = (np.concatenate([pair[i] for pair in changes]) for i in range(2))
    return before, after
