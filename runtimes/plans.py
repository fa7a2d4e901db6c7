"""The plan that a call executes: a caller's that is legal, a named one that was repaired, or the pruner's."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from ttscompile.core.lattice import BoolArray, PlanArray, check_plan, without_illegal_reads
from ttscompile.errors import IllegalPlanError

Lowered = TypeVar("Lowered")


def repair_plan(plan: npt.ArrayLike, written: BoolArray) -> tuple[PlanArray, tuple[int, ...]]:
    """Every stream's plan without illegal reads, int8 ``[B, K, blocks]``; and how many cells were replaced in each.

    Args:
        plan: ``[K, blocks]`` or ``[B, K, blocks]``.
        written: bool ``[B, K, blocks]``; rollout entries that exist.

    Raises:
        IllegalPlanError: wrong dtype, shape or values.
    """
    streams, steps, blocks = written.shape
    plans = check_plan(plan, steps, blocks, streams)
    legal = without_illegal_reads(plans, written)
    return legal, tuple(int(n) for n in np.count_nonzero(legal != plans, axis=(1, 2)))


def pruner_plan(logits: npt.NDArray[np.float32]) -> PlanArray:
    """Plans from the pruner's logits ``[B, K, blocks, 4]``: the largest of four sources, int8 ``[B, K, blocks]``."""
    if np.isnan(logits).any():
        problem = "the pruner's logits hold NaN, so there is no plan to execute: its weights are broken."
        raise IllegalPlanError(f"{problem} Calibrate the artifact again, or use plan='dense'.")
    plan: PlanArray = np.argmax(logits, axis=-1).astype(np.int8)
    return plan


class LoweringCache(Generic[Lowered]):
    """Keeps the last ``capacity`` plans that were lowered: so a schedule is lowered once."""

    def __init__(self, lower: Callable[[PlanArray], Lowered], capacity: int = 64) -> None:
        self._lower, self._capacity = lower, capacity
        self._plans: OrderedDict[bytes, Lowered] = OrderedDict()

    def lower(self, plan: PlanArray, check: Callable[[], object] = lambda: None) -> Lowered:
        """A plan, int8 ``[K, blocks]``, lowered, or what an equal one was; ``check`` raises if a new one may not be."""
        key = plan.tobytes()
        found = self._plans.get(key)
        if found is None:
            check()
            found = self._plans[key] = self._lower(plan)
            if len(self._plans) > self._capacity:
                self._plans.popitem(last=False)
        else:
            self._plans.move_to_end(key)
        return found
