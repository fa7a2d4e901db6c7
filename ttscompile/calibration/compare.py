"""What accuracy costs: held-out action error against measured latency, for strategies, plans and other artifacts.

Every point is a plan that onnxruntime executes, in the artifact's precision and with its correction. On each held-out
call all points take their turn with the same observation and the same noise, and are held against the actions of the
dense policy in fp32 with all tokens. So error and latency are of the same calls, and whatever else the machine does
hits all points. Every call is the first of an episode: nothing is reused from one to the next.

Another artifact of the policy with another sampler has no use for all of that noise: it starts from the same initial
sample, and where the number of steps is the same and its sampler is stochastic, takes the same draws. How far two dense
calls are apart that start alike and draw differently is the yardstick for its error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import DENSE
from ..core.coercion import integer
from ..core.correction import FEATURES
from ..core.lattice import Source
from ..core.spec import FP32, Noise
from ..errors import CalibrationError
from ..measure.points import Comparison, MeasuredPoint
from ..measure.timer import Timer
from ..pool import Pool, Work, artifact_elsewhere, opened_pool, place_of
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy, require_plan
from ..runtimes.random_calls import random_noise
from ..runtimes.runtime import Runtime
from ..trajectories.episodes import Episode
from .budget import cells_of, goal_of, with_plans
from .calls import FRACTION, LARGEST, Calls, Split, digest_of, load_episodes, sample_calls, split_episodes
from .execute import Executor
from .progress import Progress
from .saved_searches import Outcome, Searches
from .search import plan_of
from .strategies import strategy_of
from .targets import dense_rounds, draw_calls
from .task import Array, Found, Task

LEARNED = 256
"""Calls that strategies learn from, at most. ``calibrate`` takes more: its corrections are better."""

WARM_UP = 2
"""Rounds whose times do not count, where there are more than these; their actions count."""


@dataclass(frozen=True)
class Entrant:
    """A plan that takes part.

    Attributes:
        series: see ``MeasuredPoint``.
        name: see ``MeasuredPoint``.
        policy: the policy that runs the plan.
        plan: the plan's name in that policy.
        paired: whether it takes all the noise of the dense calls.
    """

    series: str
    name: str
    policy: CompiledPolicy
    plan: str
    paired: bool


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
        trajectories: recorded episodes, see ``ttscompile.trajectories``.
        strategies: names; each finds a plan for each sparsity.
        sparsities: shares of the cells to reuse.
        observation: see ``ttscompile.calibrate``.
        others: artifacts of the same policy, for instance with other samplers; all their plans take part.
        calls: held-out calls, at most.
        learned: calls that strategies learn from, at most.
        threads: how many threads the runtime uses.
        seed: the seed of the split, the calls, the noise and the searches.
        intervals: of a search, at most; None for the strategy's own number.
        max_minutes: of a search, about: what it has found by then takes part, and a warning says so. A strategy that
            has no plan within the budget by then is left out.
        correct: let the plans of strategies that fit no correction take part a second time, with one that is fitted to
            them, where that is better. Their series are called ``STRATEGY, corrected``.
        progress: told how far it is.
        ray: address of a Ray cluster that answers the dense calls and does the searches, or ``local``, see
            ``ttscompile.calibrate``; held-out calls are timed in this process. None does everything here.
        resume: go on after the searches that an interrupted comparison had done, with the same arguments but for
            strategies, sparsities, other artifacts and held-out calls; begins anew if none was.
        plans: of the artifact, and of others where they have one of this name, which take part beside the dense one;
            all where none is named.
        runtime: that executes the plans.
        device: see ``load``.

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
    for plan in plans:
        require_plan(artifact, plan)
    spec = artifact.manifest.spec
    budgets = {one: cells_of(goal_of(target_sparsity=one), artifact.manifest, False) for one in sparsities}
    compared: dict[str, Artifact] = {}
    for other in others:
        name = other.resolve().name
        if name in compared:
            raise CalibrationError(f"two artifacts are called {name!r}: points could not be told apart. Rename one.")
        compared[name] = load_artifact(other)
        _require_same_policy(artifact, compared[name], name)
    episodes = load_episodes(spec, trajectories, observation)
    split = split_episodes(len(episodes), FRACTION, seed)
    wished = [(strategy_of(name).name, sparsity) for name in strategies for sparsity in budgets]
    skipped: dict[str, str] = {}
    found: dict[tuple[str, float], Found] = {}
    cut: list[str] = []
    settings = {
        "model": artifact.manifest.model_identity[:16],
        "trajectories": digest_of(episodes),
        "seed": seed,
        "learned": learned,
        "intervals": intervals,
        "max_minutes": max_minutes,
        "correct": correct,
    }
    searches = Searches(path, artifact.manifest, settings, resume)
    names = {(strategy, budgets[sparsity]): f"{strategy} {sparsity:g}" for strategy, sparsity in wished}
    missing = [wish for wish in names if searches.known(*wish) is None]
    if missing:
        how = (intervals, 60 * max_minutes, correct)
        with opened_pool(ray) as pool:
            task = _task(artifact, episodes, split, learned, seed, progress, pool, searches)
            work = Work(
                partial(_searched, task, how), _searched_elsewhere, (*place_of(artifact), task.calls, seed, how)
            )
            outcomes = pool.map(work, missing)
            for number, wish in enumerate(missing, len(names) - len(missing)):
                progress(f"search: {names[wish]}", number, len(names))
                searches.keep(*wish, next(outcomes))
            progress("search", len(names), len(names))
    for strategy, sparsity in wished:
        for series, one in (searches.known(strategy, budgets[sparsity]) or {}).items():
            if isinstance(one, str):
                skipped[f"{series} {sparsity:g}"] = one
            else:
                found[series, sparsity], short = one
                cut += [f"{series} {sparsity:g}"] * short
    warnings = _warnings(artifact, split, compared)
    if missing and searches.warning:
        warnings.append(f"nothing was kept for --resume: {searches.warning}.")
    if cut:
        told = f"the limit of {max_minutes:g} minutes cut the search short of {', '.join(cut)}: see --max-minutes."
        warnings.append(told)
    if strategies and not budgets:
        warnings.append(f"no strategy takes part: no share of the cells was given for K = {artifact.manifest.steps}.")
    if pruning := [name for name in strategies if strategy_of(name).uses_pruner]:
        warnings.append(
            f"{', '.join(pruning)}: one plan for all calls takes part, of independent calls. What depends on the"
            " observation is found by 'calibrate', after which it is among the plans of the artifact."
        )
    fitted, features = [name for name in strategies if strategy_of(name).fits_correction], FEATURES * spec.sample[0]
    if fitted and learned < features:
        warnings.append(
            f"{', '.join(fitted)} fits corrections of {features} features from at most {learned} calls: its points are"
            " far worse than they would be after a calibration. Let it learn from more."
        )
    opened = partial(open_runtime, runtime=runtime, threads=threads, device=device)
    entrants = _enter(artifact, found, compared, plans, opened)
    chosen = sample_calls(episodes, split.validation, calls, seed)
    points, yardsticks = _measure(artifact, entrants, episodes, chosen, seed, threads, progress)
    searches.end()
    return Comparison(points, len(chosen), split.validation, threads, yardsticks, skipped, tuple(warnings))


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
    path: str, identity: str, calls: Calls, seed: int, how: How
) -> Callable[[tuple[str, int]], Outcome]:
    artifact = artifact_elsewhere(path, identity)
    return partial(_searched, _of_schedules(Task.of(artifact, Executor(artifact), calls, 0, seed)), how)


def _task(
    artifact: Artifact,
    episodes: Sequence[Episode],
    split: Split,
    limit: int,
    seed: int,
    progress: Progress,
    pool: Pool,
    searches: Searches,
) -> Task:
    """What strategies are given, but for the budget: calls with what the dense policy answers to them."""
    executor = Executor(artifact)
    calls = draw_calls(executor, artifact.manifest.spec, episodes, split, limit, 1, seed)["calibration"]
    paths = searches.dense(calls.count, (executor.model.steps, *calls.initial.shape[1:]))
    progress("dense calls to learn from", len(paths), calls.count)
    for found in dense_rounds(executor, calls, len(paths), pool):
        paths = torch.cat([paths, found])
        searches.keep_dense(paths)
        progress("dense calls to learn from", len(paths), calls.count)
    return _of_schedules(Task.of(artifact, executor, replace(calls, path=paths), 0, seed))


def _of_schedules(task: Task) -> Task:
    """Without constants of a pruner nobody spends time on plans that depend on the observation."""
    return replace(task, pruner={})


def _enter(
    artifact: Artifact,
    found: Mapping[tuple[str, float], Found],
    others: Mapping[str, Artifact],
    plans: Sequence[str],
    opened: Callable[[Artifact], Runtime],
) -> list[Entrant]:
    """Everything that takes part: the artifact's own plans, those of strategies, and those of other artifacts."""

    def of(one: Artifact) -> list[str]:
        return [DENSE, *(name for name in one.manifest.plans if name in plans or not plans)]

    named = {f"{strategy} {sparsity:g}": one for (strategy, sparsity), one in found.items()}
    whole = with_plans(artifact, named)
    policy = CompiledPolicy(whole, opened(whole))
    entrants = [Entrant("this artifact", name, policy, name, True) for name in of(artifact)]
    for strategy, sparsity in found:
        entrants.append(Entrant(strategy, f"{sparsity:g}", policy, f"{strategy} {sparsity:g}", True))
    sampler = artifact.manifest.spec.sampler
    for name, other in others.items():
        own = other.manifest.spec.sampler
        paired = (own.stochastic, own.name, own.steps) == (sampler.stochastic, sampler.name, sampler.steps)
        theirs = CompiledPolicy(other, opened(other))
        entrants += [Entrant(name, plan, theirs, plan, paired) for plan in of(other)]
    return entrants


def _require_same_policy(artifact: Artifact, other: Artifact, name: str) -> None:
    """Refuse an artifact that was made from another checkpoint; says what differs."""
    specs = artifact.manifest.spec, other.manifest.spec
    ours, theirs = (
        (s.original.sample, {k: o.shape for k, o in s.observations.items()}, s.chunk.start, s.chunk.stop) for s in specs
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
        held_out = ((one.manifest.calibration or {}).get("episodes") or {}).get("validation")
        if one.manifest.plans and (held_out is None or tuple(held_out) != split.validation):
            found.append(
                f"{name}: its calibration held out the episodes {held_out}, and this comparison"
                f" {list(split.validation)}: its plans may have been learned from them. Give the same files and --seed."
            )
    return found


def _measure(
    artifact: Artifact,
    entrants: Sequence[Entrant],
    episodes: Sequence[Episode],
    chosen: Sequence[tuple[int, int]],
    seed: int,
    threads: int,
    progress: Progress,
) -> tuple[tuple[MeasuredPoint, ...], dict[str, float]]:
    """All entrants on all calls, in turn: a point for each, and ``Comparison.yardsticks``.

    ``chosen`` has the number of the episode, and the row in it, of each call.
    """
    # Noise of the original's shape fits every artifact of the policy, however many steps it predicts.
    spec, draw = artifact.manifest.spec.original, np.random.default_rng((seed, 4))
    exact = artifact.at_precision(FP32).with_reuse(None)
    truth = CompiledPolicy(exact, open_runtime(exact, "onnxruntime", threads))
    errors: list[list[float]] = [[] for _ in entrants]
    reports: list[list[tuple[float, float]]] = [[] for _ in entrants]
    apart: dict[str, list[float]] = {"all": [], **({"steps": []} if spec.sampler.stochastic else {})}
    timer = Timer(len(entrants), WARM_UP if len(chosen) > WARM_UP else 0)
    for number, (episode, row) in enumerate(chosen):
        obs = {key: array[row : row + 1] for key, array in episodes[episode].observations.items()}
        one, two = random_noise(spec, draw), random_noise(spec, draw)
        dense = _call(truth, obs, one, DENSE)
        apart["all"].append(_error(_call(truth, obs, two, DENSE), dense))
        if "steps" in apart:
            apart["steps"].append(_error(_call(truth, obs, Noise(one.initial, two.steps), DENSE), dense))
        for i in timer.round():
            entrant, policy = entrants[i], entrants[i].policy
            noise = one if entrant.paired else _adapted(one, policy, draw)
            errors[i].append(_error(timer.time(i, partial(_call, policy, obs, noise, entrant.plan)), dense))
            report = policy.last_report
            assert report is not None
            reports[i].append((float(np.mean(report.plan != Source.COMPUTE)), report.flops[0]))
        progress("held-out calls", number + 1, len(chosen))
    points = []
    for entrant, wrong, times, seen in zip(entrants, errors, timer.times, reports, strict=True):
        sparsity, flops = np.mean(seen, axis=0)
        points.append(
            MeasuredPoint(
                series=entrant.series,
                name=entrant.name,
                sparsity=float(sparsity),
                flops=float(flops),
                error=float(np.mean(wrong)),
                error_p90=float(np.quantile(wrong, 0.9)),
                latency_ms=times.median,
                quartiles_ms=times.quartiles,
                noise="all" if entrant.paired else "initial",
            )
        )
    return tuple(points), {name: float(np.mean(found)) for name, found in apart.items()}


def _call(policy: CompiledPolicy, obs: Mapping[str, Array], noise: Noise, plan: str) -> Array:
    """The executed actions of a first call, ``[Ta, Da]``."""
    policy.reset()
    actions: Array = policy.predict_action(obs, noise=noise, plan=plan)["action"][0]
    return actions


def _error(actions: Array, dense: Array) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(actions - dense).mean()
    return float(np.nan_to_num(difference, nan=LARGEST, posinf=LARGEST))


def _adapted(noise: Noise, policy: CompiledPolicy, draw: np.random.Generator) -> Noise:
    """The same initial sample, with the draws that another sampler needs."""
    info = policy.info
    if not info.stochastic:
        return Noise(noise.initial)
    return Noise(noise.initial, draw.standard_normal((info.K, *noise.initial.shape), dtype=np.float32))
