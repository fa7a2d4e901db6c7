"""Searches for a criterion: it looks at each step and says which blocks are worth computing.

A criterion is a few numbers, which the record of a calibration holds as JSON. Calibration asks it once a step, between
two parts of the blocks; the runtimes execute one plan that it has decided, and ``deciding`` asks it in the call::

    stem -> blocks 0..always-1, computed -> decide(k, feature) -> the other blocks, all computed or all reused -> tail

The feature is what the first ``always`` blocks add together, or the stem's residual stream if there are none. What is
reused is the block's own last residual, so a decided plan is an ordinary plan of COMPUTE and TIMESTEP: it can be
reported, counted and replayed.

The criteria are those of ``teacache`` and ``dbcache``. The number of computed cells differs from call to call, so the
budget is kept on average: the threshold is the lowest, found by bisection, with which the mean over some of the calls
to learn from and two standard errors more are within it.

The schedule that comes with a criterion is a decision of its own, frozen: of the plans that it decided on the calls to
learn from, the one with the lowest error on all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import islice, pairwise, repeat
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner, StreamCaches, last
from ttscompile.calibration.task import Array, Found, Task
from ttscompile.core.lattice import BoolArray, PlanArray, Source
from ttscompile.core.spec import FloatArray
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError, IllegalPlanError
from ttscompile.runtimes.reference.model import Blocks

from .dense import dense_steps, some_calls
from .fixed import COMPARED, best_of, fixed

HALVINGS, DOUBLINGS = 9, 20
"""How often the interval that the threshold is in is halved, and its upper end doubled before, at most."""

COUNTED = 32
"""Calls whose computed cells decide the last threshold; fewer if there are fewer."""

FROZEN = 16
"""Decided plans at most that are compared."""

_TINY = 1e-12
"""A feature smaller than this, on average, has no relative change worth dividing for."""


@dataclass(frozen=True)
class Criterion:
    """When the blocks after the first ones are computed again.

    Attributes:
        name: of the rival that it comes from.
        always: how many blocks, from the first, are computed at every step; what they add together is the feature. 0:
            the feature is the residual stream after the stem.
        threshold: the blocks are computed where the estimated change is not below this.
        polynomial: from the relative change of the feature to the estimate, highest power first; ``(1, 0)`` leaves it
            as it is. Estimates below 0 count as 0.
        accumulates: add up the estimates from step to step until they reach the threshold; otherwise compare with the
            last step that was computed whole.
        warmup: how many steps, from the first, are computed whole; at least 1.
        closes: compute the last step whole.
    """

    name: str
    always: int
    threshold: float
    polynomial: tuple[float, ...]
    accumulates: bool
    warmup: int
    closes: bool

    def __post_init__(self) -> None:
        numbers = (self.threshold, *self.polynomial)
        if self.always < 0 or self.warmup < 1 or not self.polynomial or not all(np.isfinite(numbers)):
            raise ArtifactError(
                f"the criterion {self.name!r} has always = {self.always}, warmup = {self.warmup}, threshold ="
                f" {self.threshold}, polynomial = {self.polynomial}; expected always of at least 0, warmup of at"
                " least 1 and finite numbers. Calibrate again."
            )

    def record(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "polynomial": list(self.polynomial)}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Criterion:
        """The criterion that ``record`` gave, from the notes of a calibration.

        Raises:
            ArtifactError: members that a criterion does not have, or lacks; or values of another type.
        """
        kinds = {one.name: type(getattr(_EXAMPLE, one.name)) for one in fields(cls)}
        given: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in record.items()}
        numbers = given.get("polynomial")
        plain = isinstance(numbers, tuple) and all(type(one) in (int, float) for one in numbers)
        if {name: type(one) for name, one in given.items()} != kinds or not plain:
            expected = ", ".join(f"{name}: {kind.__name__}" for name, kind in kinds.items())
            raise ArtifactError(f"the record of a criterion has {expected}; found {record!r:.300}. Calibrate again.")
        return cls(**given)


_EXAMPLE = Criterion("", 0, 0.0, (0.0,), False, 1, False)
"""Whose members have the types that a record's have."""


class Decisions:
    """What a criterion decides during one call of B streams. Streams do not influence each other."""

    def __init__(self, criterion: Criterion, steps: int, blocks: int, streams: int) -> None:
        if criterion.always >= blocks:
            raise IllegalPlanError(
                f"the criterion {criterion.name!r} computes the first {criterion.always} blocks at every step; the"
                f" policy has {blocks}, so that nothing is left to decide. Calibrate again."
            )
        self._criterion, self._steps, self._blocks = criterion, steps, blocks
        self._accumulated = np.zeros(streams)
        self._compared: FloatArray = np.empty((streams, 0), np.float32)

    def decide(self, k: int, feature: FloatArray) -> PlanArray:
        """The row of the plan at step k; to be asked for every step, in order.

        Args:
            k: the number of the step.
            feature: ``[B, ...]``, see ``Criterion.always``.

        Returns:
            int8 ``[B, blocks]`` of COMPUTE and TIMESTEP; the first ``always`` blocks are COMPUTE.
        """
        rule = self._criterion
        flat = feature.reshape(len(feature), -1)
        whole = self._whole(k, flat)
        if rule.accumulates or k == 0:
            self._compared = flat.copy()
        else:
            self._compared[whole] = flat[whole]
        row = np.full((len(flat), self._blocks), Source.COMPUTE, np.int8)
        row[~whole, rule.always :] = Source.TIMESTEP
        return row

    def _whole(self, k: int, flat: FloatArray) -> BoolArray:
        """Which streams compute all blocks at step k."""
        rule = self._criterion
        if k == 0:
            return np.ones(len(flat), np.bool_)
        change = relative_change(flat, self._compared)
        estimate = np.maximum(np.polyval(rule.polynomial, change), 0)
        if rule.accumulates:
            self._accumulated += estimate
            estimate = self._accumulated
        whole: BoolArray = estimate >= rule.threshold
        if k < rule.warmup or (rule.closes and k == self._steps - 1):
            whole = np.ones(len(flat), np.bool_)
        self._accumulated[whole] = 0
        return whole


def relative_change(now: FloatArray, before: FloatArray) -> npt.NDArray[np.float64]:
    """Mean absolute difference over mean absolute value before, of each row: ``[B, ...]`` twice gives ``[B]``."""
    rows = len(now)
    difference = np.abs(now - before).reshape(rows, -1).mean(1, dtype=np.float64)
    size = np.abs(before).reshape(rows, -1).mean(1, dtype=np.float64)
    return np.asarray(difference / np.maximum(size, _TINY))


@dataclass(frozen=True)
class Decided:
    """What a criterion decided on some calls.

    Attributes:
        plans: int8 ``[N, K, blocks]``.
        samples: the denoised samples, ``[N, T, D]``.
    """

    plans: PlanArray
    samples: Tensor

    @property
    def cells(self) -> Array:
        """Computed cells of each call, ``[N]``."""
        return np.asarray((self.plans == Source.COMPUTE).sum((1, 2)))


def decide(runner: Runner, criterion: Criterion, calls: Calls) -> Decided:
    """Run calls with plans that the criterion decides step by step."""
    rows: list[PlanArray] = []
    with torch.no_grad():
        sample = last(runner.samples(calls, deciding_blocks(runner, criterion, calls, rows)))
    return Decided(np.stack(rows, 1), sample)


def deciding_blocks(runner: Runner, criterion: Criterion, calls: Calls, rows: list[PlanArray]) -> Blocks:
    """What the blocks make of the stem's stream where the criterion decides; rows of plans are added to ``rows``."""
    model, caches = runner.model, StreamCaches()
    decisions = Decisions(criterion, model.steps, model.blocks, calls.count)
    first, others = range(criterion.always), range(criterion.always, model.blocks)
    computed = np.full((1, model.blocks), Source.COMPUTE, np.int8)

    def blocks(k: int, stem: Tensor) -> Tensor:
        stream = runner.step(computed, k, stem, calls, caches, first)
        feature = torch.stack([caches.timestep[b] for b in first]).sum(0) if first else stem
        rows.append(decisions.decide(k, np.ascontiguousarray(feature.movedim(runner.axes[0], 0).cpu().numpy())))
        return runner.step(rows[-1], k, stream, calls, caches, others)

    return blocks


def fit_threshold(
    task: Task, criterion: Criterion, calls: Calls, low: float, high: float, probes: Iterator[object]
) -> tuple[Criterion, Decided] | None:
    """The criterion with the lowest threshold that keeps the budget, as far as bisection finds it.

    Args:
        criterion: with any threshold.
        low: a threshold that is probably too low.
        high: one that probably is not; doubled until it is not.
        probes: as many as there is time for.

    Returns:
        The criterion, and what it decides on the calls; None if the time was up before one kept the budget.
    """
    found: tuple[Criterion, Decided] | None = None

    def fits(threshold: float) -> bool:
        nonlocal found
        tried = replace(criterion, threshold=threshold)
        decided = decide(task.runner, tried, calls)
        kept = bool(decided.cells.mean() + 2 * decided.cells.std() / len(decided.cells) ** 0.5 <= task.budget)
        found = (tried, decided) if kept else found
        return kept

    for _ in islice(probes, DOUBLINGS):
        if fits(high):
            break
        low, high = high, 2 * high
    for _ in islice(probes, HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return found


def online(task: Task, proposed: Sequence[tuple[Criterion, float]]) -> Found:
    """Fit every criterion that is proposed, take the best, and fit it again on more calls."""
    probes, some, more = task.clock.in_time(repeat(None)), some_calls(task, COMPARED), some_calls(task, COUNTED)
    fitted = [fit_threshold(task, criterion, some, 0.0, start, probes) for criterion, start in proposed]
    kept = [one for one in fitted if one is not None]
    if not kept:
        raise CalibrationFailedError(
            f"the time limit ended the search for a threshold of {proposed[0][0].name!r} before one kept the budget of"
            f" {task.budget} computed cells. The artifact is as it was. Allow more time, or lower the target."
        )
    errors = [task.actions.errors(one.samples, some.targets, units=False).mean() for _, one in kept]
    best, decided = kept[int(np.argmin(errors))]
    near = max(best.threshold, 1e-6)
    best, decided = fit_threshold(task, best, more, near / 2, near, probes) or (best, decided)
    chosen = best_of(task, [(plan, {}) for plan in within(decided.plans, task.budget)[:FROZEN]])
    cells = {"mean": float(decided.cells.mean()), "most": int(decided.cells.max())}
    notes = {"criterion": best.record(), "computed_cells": cells}
    return replace(chosen, notes=notes)


def within(plans: PlanArray, budget: int) -> list[PlanArray]:
    """The different ones of ``plans [N, K, blocks]`` that are within the budget, in order."""
    computed = (plans == Source.COMPUTE).sum((1, 2))
    return list({plan.tobytes(): plan for plan in plans[computed <= budget]}.values())


FIRST = (1, 2, 3)
"""Blocks, not layers: a layer of a transformer decoder is three."""

WARMUP = (8, 1)

START = 0.5
"""A relative change to begin with; theirs are 0.05 to 0.24."""


@fixed
def dbcache(task: Task) -> Found:
    """DBCache: the first blocks are computed at every step, and the others where what those add has changed enough.

    Source: cache-dit's DBCache, which generalises ParaAttention's first-block cache. The change is relative to the last
    step that was computed whole. The user says there how many blocks come first (``Fn``) and how many steps are
    computed whole at the beginning, 8 by default; here the calls to learn from decide. ``Bn``, blocks computed at the
    end, is 0 as it is there by default.
    """
    return online(task, proposals(task))


def proposals(task: Task) -> Sequence[tuple[Criterion, float]]:
    """For each number of first blocks and of warm-up steps that the budget has room for, a criterion."""
    steps, blocks = task.runner.model.steps, task.runner.model.blocks
    if blocks < 2:
        raise CalibrationError(
            "'dbcache' decides about the blocks after the first; the policy has one block. Take teacache."
        )
    found = []
    for always in FIRST:
        for warmup in WARMUP:
            least = always * steps + min(warmup, steps) * (blocks - always)
            if always < blocks and (least <= task.budget or (always, warmup) == (1, 1)):
                criterion = Criterion("dbcache", always, START, (1.0, 0.0), False, warmup, closes=False)
                found.append((criterion, START))
    return found


DEGREE = 4

DENSE_CALLS = 8
"""Calls that the polynomial is fitted on."""


@fixed
def teacache(task: Task) -> Found:
    """TeaCache: all blocks are skipped until the accumulated, estimated change of their output is large enough.

    Source: Liu et al., Timestep Embedding Tells: It's Time to Cache for Video Diffusion Model, CVPR 2025 (arXiv
    2411.19108). What is cheap to know at each step is the input of the first block; a polynomial of degree 4, fitted on
    dense calls, turns its relative change from the step before into that of the output. First and last step are always
    computed. The input is modulated by the timestep there; here it is the residual stream after the stem.
    """
    return online(task, proposal(task))


def proposal(task: Task) -> Sequence[tuple[Criterion, float]]:
    """The criterion, and a threshold to begin with."""
    calls = some_calls(task, DENSE_CALLS)
    before, after = dense_changes(task.runner, calls)
    # A policy of fewer steps than coefficients has fewer pairs to fit.
    degree = max(0, min(DEGREE, len(np.unique(before)) - 1))
    polynomial = tuple(float(c) for c in np.linalg.lstsq(np.vander(before, degree + 1), after)[0])
    total = float(np.maximum(np.polyval(polynomial, before), 0).sum()) / calls.count
    start = max(total / max(1, task.budget // task.runner.model.blocks), 1e-3)
    return [(Criterion("teacache", 0, start, polynomial, accumulates=True, warmup=1, closes=True), start)]


def dense_changes(runner: Runner, calls: Calls) -> tuple[Array, Array]:
    """Relative changes from step to step in dense calls: of the first block's input, and of the last one's output.

    Returns:
        Two arrays ``[(K - 1) * N]``.
    """
    seen = []
    for stem, residuals in dense_steps(runner, calls):
        seen.append([value.movedim(runner.axes[0], 0).cpu().numpy() for value in (stem, sum(residuals, stem))])
    changes = [[relative_change(b, a) for a, b in zip(*pair, strict=True)] for pair in pairwise(seen)]
    before, after = (np.concatenate([pair[i] for pair in changes]) for i in range(2))
    return before, after
