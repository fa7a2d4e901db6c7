"""TaylorSeer: between whole steps what the network gives is forecast from the last two of them, as a correction.

Source: Liu et al., From Reusing to Forecasting: Accelerating Diffusion Models with TaylorSeers, ICCV 2025 (arXiv
2503.06923). Some steps are computed whole at first, then one of N. At a step k between, o and p are the last two that
were computed, and what was computed at o is moved on by its difference::

    forecast(k) = y[o] + (k - o) / (o - p) * (y[o] - y[p])

There y is what each attention and each MLP gives. A cell of the lattice adds one residual that was computed, so it
cannot hold that: ``examples/ablation/sources.py`` measures what a source that could would gain. Here y is the network's
prediction, and the forecast is a correction of the sampler's steps that is set by this formula and not fitted
(``docs/design.md``, section 2): it takes the prediction that reuse gives out of the next sample, and puts the forecast
in. That is exact where the sampler neither clips nor remembers, as that of flow matching. Where it clips, the
correction is added as if it did not, and memories of a multistep solver stay as they are. It is of first order, since a
correction reads two whole steps; the paper's tables go on to the fourth.

How many steps are computed at first is left to the user there; here the calls to learn from decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ttscompile.calibration.task import Found, Task
from ttscompile.core.correction import Correction, no_correction
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.sampler import SamplerTable

from .dense import some_calls
from .fixed import COMPARED, Fixed

WARMUP = (1, 2, 3)
"""Steps computed at first; the authors' settings have two or three."""


class TaylorSeer(Fixed):
    """The search of this module."""

    def __init__(self, task: Task) -> None:
        super().__init__(task, _best)

    def found(self) -> Found:
        """The schedule, and the correction that follows from it."""
        found = super().found()
        return replace(found, correction=correction_for(self._task, found.notes.get("steps", [0])))


def _best(task: Task) -> Found:
    """Of ``schedules`` the one whose forecasts are best."""
    model, calls = task.runner.model, some_calls(task, COMPARED)
    tried: list[tuple[float, Mapping[str, Any]]] = []
    proposed = schedules(model.steps, max(1, min(task.budget // model.blocks, model.steps)))
    for warmup, steps in task.clock.in_time(proposed.items()):
        run = task.runner.corrected(correction_for(task, steps))
        samples = run.run(whole_steps_plan(model.steps, model.blocks, steps), calls)
        error = float(task.actions.errors(samples, calls.targets, units=False).mean())
        tried.append((error, {"steps": list(steps), "warmup": warmup}))
    error, notes = min(tried, key=lambda one: one[0])
    return Found(whole_steps_plan(model.steps, model.blocks, notes["steps"]), notes, error=error)


def schedules(steps: int, count: int) -> dict[int, tuple[int, ...]]:
    """For each number of steps at first, ``count`` steps to compute: after the last of these they are evenly spaced."""
    found = {}
    for warmup in WARMUP[: max(1, count - 1)]:
        last, others = warmup - 1, count - warmup + 1
        spaced = (last + step * (steps - last) // others for step in range(others))
        found[warmup] = (*range(last), *spaced)
    return found


def forecast(k: int, before: Sequence[int]) -> tuple[float, float]:
    """Shares of what the last whole step, and the one before it, gave, in the forecast at step k.

    Args:
        k: the step.
        before: the steps that are computed before it, in order; of a single one nothing is moved on.
    """
    if len(before) < 2:
        return 1.0, 0.0
    moved = (k - before[-1]) / (before[-1] - before[-2])
    return 1.0 + moved, -moved


def correction_for(task: Task, steps: Sequence[int]) -> Correction:
    """What puts the forecasts in the place of what reuse predicts, where these steps are computed."""
    view = task.runner.view
    spec = view.manifest.spec
    share = of_prediction(spec.sampler)
    nothing, (horizon, _) = no_correction(spec.sampler.steps, spec.sample, view.groups), spec.sample
    weights = nothing.weights.copy()
    for k in sorted(set(range(spec.sampler.steps)) - set(steps)):
        newest, older = forecast(k, [step for step in steps if step < k])
        # [sample, prediction], then both of the last anchor, then both of the one before it
        for place, factor in ((1, -1.0), (3, newest), (5, older)):
            weights[k, :, place * horizon : (place + 1) * horizon] = share[k] * factor * np.eye(horizon)
    return replace(nothing, anchors=np.isin(np.arange(spec.sampler.steps), list(steps)), weights=weights)


def of_prediction(sampler: SamplerTable) -> np.ndarray:
    """The share of the prediction in the next sample, at each step, where nothing is clipped: ``[K]``."""
    return np.asarray(sampler.x0_to_next * sampler.out_to_x0 + sampler.out_to_next)
