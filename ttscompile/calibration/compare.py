"""What accuracy costs: the judge on a list of plans, of strategies, of the artifact, and of other artifacts.

Every point is a plan that a runtime executes, in its precision and with its correction, on the same held-out calls;
how far its actions are from those of the original, and what a call takes: all points take their turn, so that whatever
else the machine does hits all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..artifact.load import Artifact, load_artifact
from ..core.coercion import integer
from ..core.correction import FEATURES
from ..core.plan import DENSE, Plan
from ..errors import CalibrationError
from ..measure.points import Comparison, MeasuredPoint
from ..pool import Work, opened_pool
from ..runtimes.open import require_able
from .budget import cells_of, goal_of
from .calls import Calls, Split, digest_of, load_episodes
from .execute import Executor
from .judge import judge, other_noise, timed
from .progress import Progress
from .saved_searches import Outcome, Searches
from .search import plan_of
from .state import COMPARISON, StateFile
from .strategies import strategy_of
from .targets import executor_elsewhere, where
from .task import Task
from .trials import Trials

LEARNED = 256
"""Calls that strategies learn from, at most. ``calibrate`` takes more: its corrections are better."""


@dataclass(frozen=True, eq=False)
class Entrant:
    """A plan that takes part."""

    series: str
    name: str
    trials: Trials
    plan: Plan


def compare(
    path: Path,
    trajectories: Sequence[Path],
    strategies: Sequence[str],
    sparsities: Sequence[float],
    others: Sequence[Path] = (),
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    calls: int = 32,
    learned: int = LEARNED,
    threads: int = 1,
    seed: int = 0,
    intervals: int | None = None,
    max_minutes: float = 3.0,
    correct: bool = False,
    progress: Progress = lambda what, done, total: None,
    ray: str | None = None,
    resume: bool = False,
    plans: Sequence[str] = (),
    runtime: str = "onnxruntime",
    device: str | None = None,
) -> Comparison:
    """Measure plans against each other. Searches that are done are kept in the artifact's directory until the end.

    Args:
        path: the artifact whose dense policy is the truth.
        strategies: names; each finds a plan for each sparsity.
        sparsities: shares of the cells to reuse.
        observation: see ``ttscompile.calibrate``.
        others: artifacts of the same policy, for instance with other samplers; their plans take part.
        calls: held-out calls, at most; half as many where the artifact has further loops (``trials.MANY_DRAWS``).
        learned: calls that strategies learn from, at most.
        seed: the seed of the split, the calls, the noise and the searches.
        intervals: of a search, at most; None for the strategy's own number.
        max_minutes: of a search, about: what it has found by then takes part, and a warning says so. A strategy that
            has no plan within the budget by then is left out.
        correct: let the plans of strategies that fit no correction take part a second time, with one that is fitted to
            them, where that is better. Their series are called ``STRATEGY, corrected``.
        ray: address of a Ray cluster that answers the dense calls and does the searches, or ``local``, see
            ``ttscompile.calibrate``; held-out calls are timed in this process. None does everything here.
        resume: go on after the searches that an interrupted comparison had done, with the same arguments but for
            strategies, sparsities, other artifacts and held-out calls; begins anew if none was.
        plans: of the artifact, and of others where they have one of this name, which take part beside the dense one;
            all where none is named. ``NAME@PRECISION`` is one in another precision.

    Raises:
        ClusterError: the cluster cannot be reached, or is gone; what was done before can be resumed.
        CalibrationError: an unknown strategy, a sparsity that nothing reaches, an artifact of another policy, or
            nothing to resume with these arguments.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: an artifact cannot be opened.
        IllegalPlanError: the artifact has no plan of this name.
    """
    calls, learned = integer(calls, "calls", CalibrationError, 1), integer(learned, "learned", CalibrationError, 2)
    threads, seed = integer(threads, "threads", CalibrationError, 1), integer(seed, "seed", CalibrationError)
    if intervals is not None:
        intervals = integer(intervals, "intervals", CalibrationError, 1)
    artifact = load_artifact(path)
    for name in plans:
        require_able(runtime, artifact, artifact.plan(name))  # refused before anything is searched for
    compared: dict[str, Artifact] = {}
    for other in others:
        name = other.resolve().name
        if name in compared:
            raise CalibrationError(f"two artifacts are called {name!r}: points could not be told apart. Rename one.")
        compared[name] = load_artifact(other)
        _require_same_policy(artifact, compared[name], name)
    episodes = load_episodes(artifact.manifest.spec, trajectories, observation)
    settings = {
        "model": artifact.manifest.model_identity[:16],
        "trajectories": digest_of(episodes),
        "seed": seed,
        "learned": learned,
        "intervals": intervals,
        "max_minutes": max_minutes,
        "correct": correct,
    }
    with opened_pool(ray) as pool:
        state = StateFile(path, settings, COMPARISON, needed=False)
        limits = learned, learned
        on = None if device is None else torch.device(device)
        how: dict[str, Any] = {"limits": limits, "observations": calls, "device": on, "runtime": runtime}
        trials = Trials.of(artifact, episodes, state, seed=seed, pool=pool, **how)
        manifest = trials.executor.view.manifest
        budgets = {one: cells_of(goal_of(target_sparsity=one), manifest, False) for one in sparsities}
        wished = [(strategy_of(name).name, sparsity) for name in strategies for sparsity in budgets]
        if not (resume and state.load()):
            state.remove()
        searches = Searches(state, (manifest.steps, len(manifest.blocks)))
        names = {(strategy, budgets[sparsity]): f"{strategy} {sparsity:g}" for strategy, sparsity in wished}
        missing = [wish for wish in names if searches.known(*wish) is None]
        if missing:
            progress("dense calls to learn from", 0, 1)
            effort, task = (intervals, 60 * max_minutes, correct), _of_schedules(trials.executor, trials.calls, seed)
            given = *where(trials.executor), trials.calls, seed, effort
            outcomes = pool.map(Work(partial(_searched, task, effort), _searched_elsewhere, given), missing)
            for number, wish in enumerate(missing, len(names) - len(missing)):
                progress(f"search: {names[wish]}", number, len(names))
                searches.keep(*wish, next(outcomes))
            progress("search", len(names), len(names))
        entrants = [Entrant("this artifact", name, trials, plan) for name, plan in named_plans(artifact, plans).items()]
        skipped, cut = dict[str, str](), list[str]()
        for strategy, sparsity in wished:
            for series, one in (searches.known(strategy, budgets[sparsity]) or {}).items():
                if isinstance(one, str):
                    skipped[f"{series} {sparsity:g}"] = one
                    continue
                found, short = one
                plan = replace(trials.base, cells=found.schedule, correction=found.correction)
                entrants.append(Entrant(series, f"{sparsity:g}", trials, plan))
                cut += [f"{series} {sparsity:g}"] * short
        for name, other_artifact in compared.items():
            own = replace(trials, artifact=other_artifact)
            entrants += [Entrant(name, plan, own, one) for plan, one in named_plans(other_artifact, plans).items()]
        points = _measured(entrants, threads, progress)
        warnings = _warnings(artifact, trials.split, compared)
        if missing and state.warning:
            warnings.append(f"nothing was kept for --resume: {state.warning}.")
        if cut:
            told = f"the limit of {max_minutes:g} minutes cut the search short of {', '.join(cut)}: see --max-minutes."
            warnings.append(told)
        warnings += _of_strategies(strategies, budgets, manifest.steps, learned, FEATURES * manifest.spec.sample[0])
        state.remove()
        held_out = trials.held_out
        return Comparison(
            points, len(held_out.calls), trials.split.validation, threads, other_noise(trials), skipped, tuple(warnings)
        )


def named_plans(artifact: Artifact, names: Sequence[str] = ()) -> dict[str, Plan]:
    """The dense plan, and those of these names that an artifact has; all where none is named. See ``Artifact.plan``."""
    known = [name for name in names if name.partition("@")[0] in artifact.plans]
    return {name: artifact.plan(name) for name in (DENSE, *(known if names else artifact.plans))}


How = tuple[int | None, float, bool]
"""Intervals at most, seconds of a search, and whether its plan takes part with a correction too."""


def _searched(task: Task, how: How, wish: tuple[str, int]) -> Outcome:
    """What a strategy, the first of the wish, finds for so many cells."""
    (strategy, cells), (intervals, seconds, correct) = wish, how
    try:
        found, short = plan_of(strategy, replace(task, budget=cells), intervals, seconds)
    except CalibrationError as error:
        return {strategy: str(error)}
    outcome: Outcome = {strategy: (found, short)}
    if correct and not strategy_of(strategy).fits_correction:
        try:
            outcome[f"{strategy}, corrected"] = task.corrected(found), False
        except CalibrationError as error:
            outcome[f"{strategy}, corrected"] = str(error)
    return outcome


def _searched_elsewhere(
    path: str, identity: str, loop: str, calls: Calls, seed: int, how: How
) -> Callable[[tuple[str, int]], Outcome]:
    return partial(_searched, _of_schedules(executor_elsewhere(path, identity, loop), calls, seed), how)


def _of_schedules(executor: Executor, calls: Calls, seed: int) -> Task:
    """What strategies are given, but for the budget.

    Without constants of a pruner nobody spends time on plans that depend on the observation.
    """
    return replace(Task.of(executor, calls, 0, seed), pruner={})


def _measured(entrants: Sequence[Entrant], threads: int, progress: Progress) -> tuple[MeasuredPoint, ...]:
    """All entrants judged, and then timed in turn."""
    scores = []
    for number, one in enumerate(entrants):
        progress("held-out calls", number, len(entrants))
        scores.append(judge(one.trials, one.plan))
    times = timed([(one.trials, one.plan) for one in entrants], threads)
    progress("held-out calls", len(entrants), len(entrants))
    return tuple(
        MeasuredPoint(
            series=one.series,
            name=one.name,
            distance=score.distance,
            interval=score.interval,
            error=score.error,
            error_p90=score.error_p90,
            latency_ms=took.median,
            quartiles_ms=took.quartiles,
            sparsity=score.sparsity,
            flops=(1 - score.flops_saved) * one.trials.artifact.manifest.flops.dense,
        )
        for one, score, took in zip(entrants, scores, times, strict=True)
    )


def _of_strategies(
    strategies: Sequence[str], budgets: Mapping[float, int], steps: int, learned: int, features: int
) -> list[str]:
    """What a reader has to know of the strategies that take part."""
    found = []
    if strategies and not budgets:
        found.append(f"no strategy takes part: no share of the cells was given for K = {steps}.")
    if pruning := [name for name in strategies if strategy_of(name).uses_pruner]:
        found.append(
            f"{', '.join(pruning)}: one plan for all calls takes part, of independent calls. What depends on the"
            " observation is found by 'calibrate', after which it is among the plans of the artifact."
        )
    fitted = [name for name in strategies if strategy_of(name).fits_correction]
    if fitted and learned < features:
        found.append(
            f"{', '.join(fitted)} fits corrections of {features} features from at most {learned} calls: its points are"
            " far worse than they would be after a calibration. Let it learn from more."
        )
    return found


def _require_same_policy(artifact: Artifact, other: Artifact, name: str) -> None:
    """Refuse an artifact that was made from another checkpoint; says what differs."""
    specs = artifact.manifest.spec, other.manifest.spec
    ours, theirs = (
        (s.whole_horizon.sample, {k: o.shape for k, o in s.observations.items()}, s.chunk.start, s.chunk.stop)
        for s in specs
    )
    # Masks and position tables are shorter where fewer steps are predicted; the weights proper are not.
    narrower = specs[0].sample != specs[1].sample
    pairs = [(value, other.weights[key]) for key, value in artifact.weights.items() if key in other.weights]
    same = [np.array_equal(*pair) for pair in pairs if not narrower or pair[0].shape == pair[1].shape]
    if ours != theirs or not (same and all(same)):
        what = f"{theirs} instead of {ours}" if ours != theirs else "other weights"
        raise CalibrationError(
            f"{name}: expected an artifact of the same checkpoint; found {what}. Actions of different policies cannot"
            " be held against each other: convert the same checkpoint with another --sampler, --steps or --precision."
        )


def _warnings(artifact: Artifact, split: Split, others: Mapping[str, Artifact]) -> list[str]:
    """Plans that may have been learned from the episodes that they are judged on here."""
    found = []
    for name, one in {"this artifact": artifact, **others}.items():
        held_out = (one.manifest.calibration or {}).get("episodes", {}).get("validation")
        if one.manifest.plans and (held_out is None or tuple(held_out) != split.validation):
            found.append(
                f"{name}: its calibration held out the episodes {held_out}, and this comparison"
                f" {list(split.validation)}: its plans may have been learned from them. Give the same files and seed."
            )
    return found
