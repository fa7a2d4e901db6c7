"""Calibration, as one straight line: episodes -> calls -> targets -> strategy -> judgement -> artifact."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..artifact.ceiling import few_steps, usual_sparsity
from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import UNIFORM
from ..artifact.write import locked, update_calibration
from ..core.coercion import integer
from ..core.lattice import sparsity
from ..errors import CalibrationError
from ..ir.pieces import PRUNER
from ..pool import opened_pool
from ..runtimes.torch.devices import device_of, exact_arithmetic
from ..verification.record_golden import record_plans
from .arguments import JUDGED, calls_to_learn_from, require_directory, require_limits
from .budget import ERROR, LATENCY, Budget, Goal, cells_of, goal_of, measure_budget
from .calls import FRACTION, Calls, digest_of, load_episodes, split_episodes, window_of
from .clock import Clock
from .execute import Executor
from .judge import (
    SCHEDULE,
    default_of,
    dense_with_other_noise,
    judge,
    precision_record,
    require_success,
    uniform_of,
)
from .progress import Bar
from .pruner.head import has_head
from .result import CalibrationResult
from .search import open_search, search_plan
from .state import StateFile
from .step_counts import SAFE, SHARE, SpacedSchedules, budget_of_error, named_plans
from .strategies import DEFAULT, FITTED, Strategy, strategy_of
from .targets import draw_calls, with_targets
from .task import Found, Search, Task


def calibrate(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    target_sparsity: float | None = None,
    strategy: str = DEFAULT,
    seed: int = 0,
    resume: bool = False,
    *,
    target_flops: float | None = None,
    latency_ms: float | None = None,
    max_action_error: float | None = None,
    threads: int = 1,
    max_minutes: float = 15.0,
    validation_fraction: float = FRACTION,
    observation: Mapping[str, Sequence[str]] | None = None,
    max_intervals: int | None = None,
    correct: bool = False,
    device: str | None = None,
    progress: bool = True,
    ray: str | None = None,
) -> CalibrationResult:
    """Learn which residuals an artifact can reuse, from a few recorded episodes, and write the plans into it.

    Targets come from the dense policy with the same noise. Plans are judged on episodes that they were not learned
    from. After every interval of some seconds the state is saved in the artifact's directory: whatever stops the
    process, a call with ``resume`` goes on from there, and ends where it would have ended. The same arguments give the
    same bytes, unless the time limit cuts something short, or the budget is a latency, which is measured.

    At most one budget: ``target_sparsity``, ``target_flops``, ``latency_ms`` or ``max_action_error``. Beside the plan
    that keeps it, ``schedule``, the artifact gets ``uniform``, the baseline. A strategy that fits corrections adds
    ``safe``, which computes twice as many cells, and ``fast``, which computes half as many.

    Args:
        path: the artifact's directory.
        trajectories: recordings: ``.npz``, zarr, HDF5 or LeRobot data sets, see ``ttscompile.trajectories``.
        target_sparsity: share of the cells to reuse; if no budget is given, 0.95, or what leaves five whole steps.
        strategy: how the plan is found, see ``ttscompile.calibration.strategies``.
        seed: the seed of the split, the noise and the search.
        resume: go on where a calibration with the same arguments was interrupted, with the same calls whatever
            ``max_minutes`` is now; begins anew if none was.
        target_flops: share of the FLOPs of a dense call to save, prologue and pruner counted.
        latency_ms: of a call with onnxruntime on this machine. Measured once, for as many whole steps as fit.
        max_action_error: mean absolute error of the executed actions on held-out episodes, in their units; the plan is
            the sparsest that was found below it. Only with a strategy that fits corrections.
        threads: how many threads the calls have that are timed for ``latency_ms``.
        max_minutes: the best plan so far is taken in time to be finished by then, as far as what was done before lets
            it be known; what has to be done at least is done. Also decides how many calls are used.
        validation_fraction: of the episodes.
        observation: by key, the arrays of a recording that it is made of, where they are called otherwise.
        correct: fit a correction of the sampler to the schedule of a strategy that fits none itself, and keep it if it
            is better on calls that it was not fitted on.
        device: where the calls compute that are made to learn from, as torch calls it, ``cuda``; None for the CPU. The
            results differ from those of the CPU by rounding. ``latency_ms`` is of onnxruntime, on the CPU.
        max_intervals: an end that does not depend on the machine's speed; None for the strategy's own.
        progress: show a bar on standard error.
        ray: address of a Ray cluster that answers dense calls and compares candidates, or ``local`` for one of this
            machine's cores; the outcome is the same. All its machines see the artifact under the same path. None
            works in this process.

    Returns:
        What was achieved.

    Raises:
        CalibrationFailedError: the budget was not kept, or the plan is no better than the uniform schedule that
            computes as much. The artifact is as it was.
        CalibrationError: the arguments cannot be satisfied, or there is nothing to resume with these.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: no artifact, one that another process is changing, or it cannot be written.
        RuntimeUnavailableError: torch does not have the device.
        ClusterError: the cluster cannot be reached, or is gone; what was done before can be resumed.
    """
    begun = time.monotonic()
    seed = integer(seed, "seed", CalibrationError)
    if max_intervals is not None:
        max_intervals = integer(max_intervals, "max_intervals", CalibrationError, 1)
    if ray is not None and device is not None:
        raise CalibrationError(
            f"expected a device or a cluster; found device {device!r} and ray {ray!r}: workers of a cluster compute on"
            " their processors. Leave one of the two out."
        )
    there = None if device is None else device_of(device)
    asked = (target_sparsity, target_flops, latency_ms, max_action_error, threads)
    goal_of(*asked)  # what cannot be is refused before anything is read
    require_limits(validation_fraction, max_minutes)
    require_directory(Path(path))
    # All the while: a second calibration would undo the first.
    with locked(Path(path)), opened_pool(ray) as pool, exact_arithmetic(there):
        artifact = load_artifact(Path(path))
        goal = goal_of(*asked, usual=usual_sparsity(artifact.manifest.steps))
        spec, chosen = artifact.manifest.spec, strategy_of(strategy)
        if correct and chosen.fits_correction:
            raise CalibrationError(f"strategy {strategy!r} fits a correction of its own. Leave --correct out.")
        budget = _known_budget(artifact, goal, chosen)
        episodes = load_episodes(spec, trajectories, observation)
        split = split_episodes(len(episodes), validation_fraction, seed)
        corrects = chosen.fits_correction or correct
        fewest, limit = calls_to_learn_from(artifact.manifest, max_minutes, corrects)
        state = StateFile(
            Path(path),
            {
                "model": artifact.manifest.model_identity[:16],
                "trajectories": digest_of(episodes),
                "budget": goal.record(),
                "strategy": strategy,
                "seed": seed,
                "validation_fraction": validation_fraction,
                "max_intervals": max_intervals,
                "correct": correct,
                "device": "cpu" if there is None else str(there),
            },
        )
        if not (resume and state.load()):
            state.remove()
        limit = state.progress.setdefault("calls", limit)  # whatever time there is to go on
        clock = Clock(60 * max_minutes, float(state.progress.get("seconds", 0.0)), begun)
        if goal.kind == LATENCY:
            budget = _timed_budget(artifact, goal, chosen, state, clock)
        executor = Executor(artifact, there)
        window = window_of(episodes, split) if chosen.consecutive else 1
        sets = draw_calls(executor, spec, episodes, split, limit, min(JUDGED, limit // 2), seed, window)
        with Bar(progress) as bar:
            if (warning := few_steps(artifact.manifest)) is not None:
                bar.warn(warning)
            if short := sum(each.calls < window for each in episodes):
                bar.warn(
                    f"{short} of {len(episodes)} episodes have fewer than {window} calls, and are left out: strategy"
                    f" {strategy!r} takes {window} consecutive ones."
                )
            least = {"calibration": fewest, "validation": limit}
            sets = {
                name: with_targets(executor, name, calls, least[name], state, clock, bar, pool)
                for name, calls in sets.items()
            }
            if corrects and (count := sets["calibration"].count) < fewest:
                bar.warn(
                    f"the recordings give {count} calls to learn from, and a correction needs {fewest}: it may do harm"
                    " where nothing was recorded. Record more episodes."
                )
            if clock.left() < 0:
                bar.warn(
                    f"{max_minutes:g} minutes were over when the dense policy had answered the calls to learn from:"
                    f" strategy {strategy!r} needs {fewest}. Its search is the shortest there is; allow more time."
                )
            task = Task.of(artifact, executor, sets["calibration"], 0, seed, pool)
            crowded = SpacedSchedules(task.whole, state, clock, bar)
            if budget is None:
                budget = budget_of_error(crowded, goal, artifact.manifest.steps, len(artifact.manifest.blocks))
            task = replace(task, budget=budget.cells, clock=clock.until(1 - SHARE) if chosen.fits_correction else clock)
            found, intervals, stopped = _search(open_search(strategy, task), state, task.clock, bar, max_intervals)
            if correct:
                found = task.corrected(found)
            if goal.kind == ERROR:
                found, budget = _relax(artifact, crowded, task, found, budget, sets["validation"])
            named, skipped = named_plans(crowded, task, chosen, budget.cells)
        plans = {SCHEDULE: found, UNIFORM: uniform_of(artifact.manifest, budget.cells), **named}
        scores = judge(artifact, executor, plans, sets["validation"])
        if SAFE in scores and not scores[SAFE].error < scores[SCHEDULE].error:
            del plans[SAFE]
            skipped[SAFE] = f"{scores.pop(SAFE).error:.4g} off, no safer than {SCHEDULE}: its search was cut short"
        result = CalibrationResult(
            strategy=strategy,
            seed=seed,
            target_sparsity=goal.sparsity(budget.cells, artifact.manifest),
            budget=budget.record(),
            default_plan=default_of(scores, goal, budget.cells, artifact.manifest),
            plans=scores,
            other_noise=dense_with_other_noise(artifact, executor, sets["validation"], seed),
            skipped=skipped,
            episodes={"calibration": split.calibration, "validation": split.validation},
            calls={name: calls.count for name, calls in sets.items()},
            intervals=intervals,
            stopped=stopped,
            seconds=clock.elapsed(),
        )
        require_success(result, goal)
        precision = precision_record(artifact, episodes, split.validation, found, seed)
        _write(Path(path), artifact, result, plans, precision)
        state.remove()
        return result


def _write(
    path: Path, artifact: Artifact, result: CalibrationResult, plans: Mapping[str, Found], precision: Mapping[str, Any]
) -> None:
    """Put the plans into the artifact."""
    found = plans[SCHEDULE]
    corrections = {name: one.correction for name, one in plans.items() if one.correction is not None}
    if found.pruner is not None and found.pruner_correction is not None:
        corrections[PRUNER] = found.pruner_correction
    steps = {name: one.notes["steps"] for name, one in plans.items() if name not in (SCHEDULE, UNIFORM)}
    update_calibration(
        path,
        found.pruner,
        {name: one.schedule for name, one in plans.items()},
        result.default_plan,
        {**result.record(), **found.notes, **precision, "named_steps": steps},
        corrections=corrections,
        model_identity=artifact.manifest.model_identity,
        golden=record_plans,
        held=True,
    )


def _known_budget(artifact: Artifact, goal: Goal, strategy: Strategy) -> Budget | None:
    """The budget where nothing has to be run for it; refuses what cannot be satisfied before any work."""
    if artifact.manifest.steps == 1:
        told = "the policy has one denoising step, which every plan computes: nothing can be reused"
        raise CalibrationError(f"{told}. Convert with more denoising steps, or use plan='dense'.")
    if goal.kind == ERROR and not strategy.fits_correction:
        raise CalibrationError(
            f"max_action_error needs strategy {' or '.join(map(repr, FITTED))}; found {strategy.name!r}. Give this"
            " strategy a target_sparsity, a target_flops or a latency_ms."
        )
    if goal.kind in (LATENCY, ERROR):
        return None
    cells = cells_of(goal, artifact.manifest, _may_prune(artifact, strategy))
    strategy.require_reach(artifact.manifest.steps, len(artifact.manifest.blocks), cells)
    return Budget(goal, cells)


def _timed_budget(artifact: Artifact, goal: Goal, strategy: Strategy, state: StateFile, clock: Clock) -> Budget:
    """The budget of a latency: measured, or what was measured before an interruption."""
    known = state.progress.get("latency")
    if known is None:
        budget = measure_budget(artifact, goal, _may_prune(artifact, strategy))
        state.progress.update(latency={"cells": budget.cells, "measured": budget.measured}, seconds=clock.elapsed())
        state.save()
    else:
        budget = Budget(goal, known["cells"], known["measured"])
    strategy.require_reach(artifact.manifest.steps, len(artifact.manifest.blocks), budget.cells)
    return budget


def _may_prune(artifact: Artifact, strategy: Strategy) -> bool:
    """Whether plans may be made by the pruner, whose cost then counts."""
    return strategy.uses_pruner and has_head(artifact.pruner)


def _search(search: Search, state: StateFile, clock: Clock, bar: Bar, most: int | None) -> tuple[Found, int, str]:
    """``search_plan`` from where the state is; saved after every interval."""
    first = int(state.progress.get("intervals", 0))
    count = search.intervals if most is None else min(most, search.intervals)
    if first:
        with state.reading():
            search.restore(state.get("strategy"))
    bar.stage("search", count, first)

    def save(done: int, longest: float) -> None:
        state.put("strategy", search.state())
        state.progress.update(intervals=done, seconds=clock.elapsed())
        state.save()
        left = min(clock.left(), (count - done) * longest)
        bar.update(done, f"error {search.loss:.4f}, sparsity {sparsity(search.plan):.2%}", left)

    return search_plan(search, clock, most, first, save)


def _relax(
    artifact: Artifact, crowded: SpacedSchedules, task: Task, found: Found, budget: Budget, held_out: Calls
) -> tuple[Found, Budget]:
    """More steps, as long as the held-out error is above what was asked for and at least half of them are left out."""
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)

    def misses(one: Found, cells: int) -> bool:
        scores = judge(artifact, task.executor, {SCHEDULE: one}, held_out)
        return not scores[default_of(scores, budget.goal, cells, artifact.manifest)].error <= budget.goal.value

    while misses(found, budget.cells):
        full = budget.cells // blocks
        more = full + max(1, full // 4)
        best = crowded.best(more, f"{more} steps") if more <= steps // 2 else None
        if best is None:
            break
        found, budget = task.whole_steps(best.steps), replace(budget, cells=more * blocks)
    return found, budget
