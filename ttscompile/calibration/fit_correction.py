"""Fit the correction of a schedule: least squares, step by step, on calls whose dense path is known.

At step k the sparse loop, corrected so far, has features; the correction of the step is the ridge regression, on these
and on the principal components of the condition, of what is missing to the sample that the dense policy has after the
step with the same noise. Then all calls go on with it. So every step is fitted where the loop will be when it gets
there, and what one step leaves over the next can still repair. One pass of sparse calls: seconds. Where the steps
between two anchors end, a jump is fitted to what the corrections leave over, if it holds on other episodes. Jumps stay
if the loop then ends nearer to the dense policy, with each call moved by jumps that do not know its episode.
"""

from __future__ import annotations

from ..core.correction import Correction, may_jump
from ..core.lattice import PlanArray
from .calls import Calls
from .execute import Executor
from .sparse_loop import SparseLoop, is_whole


def fit_correction(executor: Executor, plan: PlanArray, calls: Calls, reads: bool) -> Correction | None:
    """The correction of a schedule, or one for all plans of a pruner; None where the sparse loop ends in no numbers.

    Args:
        plan: ``[K, blocks]``, or ``[N, K, blocks]`` for each call one of its own. It may read the rollout cache where
            the calls are windows.
    """
    loop = SparseLoop(executor, calls, None, reads=reads, whole=is_whole(plan))
    ends = loop.ends(plan) if may_jump(executor.view.manifest.spec.sample) else (loop.end(plan),)
    return loop.correction(min(ends, key=lambda place: float((place.fitted_samples - calls.targets).abs().mean())))
