"""What accuracy costs: held-out action error against measured latency, for strategies, plans and other artifacts.

Every point is a plan that onnxruntime executes, in the artifact's precision and with its correction. On each held-out
call all points take their turn with the same observation and the same noise, and are held against the actions of the
dense policy in fp32. So error and latency are of the same calls, and whatever else the machine does hits all points.

Another artifact of the policy with another sampler has no use for all of that noise: it starts from the same initial
sample, and where the number of steps is the same and its sampler is stochastic, takes the same draws. How far two dense
calls are apart that start alike and draw differently is the yardstick for its error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import DENSE
from ..core.correction import FEATURES
from ..errors import CalibrationError
from ..measure.points import Frontier
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from ..trajectories.episodes import Episode, load_trajectories
from .budget import cells_of, goal_of
from .calls import Actions, Split, require_seed, sample_calls, split_episodes
from .contest import Entrant, Progress, measure
from .execute import Executor
from .latency import with_plans
from .strategies import Found, Task, plan_of, require_reach, require_strategy
from .targets import dense_rounds, draw_calls

LEARNED = 256
"""Calls that strategies learn from, at most. ``calibrate`` takes up to 960: its corrections are better."""

FRACTION = 0.25
"""Of the episodes, to judge on: the default of ``calibrate``, so that with its seed its plans saw none of them."""


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
    progress: Progress = lambda what, done, total: None,
) -> Frontier:
    """Measure plans against each other. Nothing is written.

    Args:
        path: of the artifact, whose dense policy is the truth.
        trajectories: recorded episodes, see ``ttscompile.trajectories``.
        strategies: names; each finds a plan for each sparsity.
        sparsities: shares of the cells to reuse.
        observation: see ``ttscompile.calibrate``.
        others: artifacts of the same policy, for instance with other samplers; all their plans take part.
        calls: held-out calls, at most.
        learned: calls that strategies learn from, at most.
        threads: of onnxruntime.
        seed: of the split, the calls, the noise and the searches.
        intervals: of a search, at most; None for the strategy's own number.
        max_minutes: of a search, about: what it has found by then takes part, and a warning says so. A strategy that
            has no plan within the budget by then is left out.
        progress: told how far it is.

    Raises:
        CalibrationError: an unknown strategy, a sparsity that nothing reaches, or an artifact of another policy.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: an artifact cannot be opened.
    """
    if calls < 1 or learned < 2:
        raise CalibrationError(f"expected at least 1 call and 2 to learn from; found {calls} and {learned}.")
    require_seed(seed)
    artifact = load_artifact(path)
    spec = artifact.manifest.spec
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)
    budgets = {one: cells_of(goal_of(target_sparsity=one), artifact.manifest, False) for one in sparsities}
    compared = {_unique(other.resolve().name, others): load_artifact(other) for other in others}
    for name, other in compared.items():
        _require_same_policy(artifact, other, name)
    episodes = load_trajectories(trajectories, spec.observations, spec.chunk.stop - spec.chunk.start, observation)
    if len(episodes) < 2:
        raise CalibrationError(
            "the trajectories hold one episode; expected at least two: one is held out. Record more."
        )
    split = split_episodes(len(episodes), FRACTION, seed)
    skipped: dict[str, str] = {}
    wished: list[tuple[str, float]] = []
    for strategy in strategies:
        require_strategy(strategy)
        for sparsity, cells in budgets.items():
            try:
                require_reach(strategy, steps, blocks, cells)
            except CalibrationError as error:
                skipped[f"{strategy} {sparsity:g}"] = str(error)
            else:
                wished.append((strategy, sparsity))
    found: dict[tuple[str, float], Found] = {}
    cut: list[str] = []
    if wished:
        task = _task(artifact, episodes, split, learned, seed, progress)
    for number, (strategy, sparsity) in enumerate(wished):
        name = f"{strategy} {sparsity:g}"
        progress(f"search: {name}", number, len(wished))
        try:
            one, short = plan_of(strategy, replace(task, budget=budgets[sparsity]), intervals, 60 * max_minutes)
        except CalibrationError as error:
            skipped[name] = str(error)
        else:
            found[strategy, sparsity] = one
            cut += [name] * short
    if wished:
        progress("search", len(wished), len(wished))
    entrants = _enter(artifact, found, compared, threads)
    chosen = sample_calls(episodes, split.validation, calls, seed)
    warnings = _warnings(artifact, split, compared)
    if cut:
        told = f"the limit of {max_minutes:g} minutes cut the search short of {', '.join(cut)}: see --max-minutes."
        warnings = (*warnings, told)
    if "tts" in strategies and learned < FEATURES * spec.sample[0]:
        few = (
            f"tts fits corrections of {FEATURES * spec.sample[0]} features from at most {learned} calls: its points are"
            " far worse than they would be after a calibration. Let it learn from more."
        )
        warnings = (*warnings, few)
    points, yardsticks = measure(artifact, entrants, episodes, chosen, seed, threads, progress)
    return Frontier(points, len(chosen), split.validation, threads, yardsticks, skipped, warnings)


def _task(
    artifact: Artifact, episodes: Sequence[Episode], split: Split, limit: int, seed: int, progress: Progress
) -> Task:
    """What strategies are given, but for the budget: calls with what the dense policy answers to them."""
    spec, executor = artifact.manifest.spec, Executor(artifact)
    calls = draw_calls(executor, spec, episodes, split, limit, 1, seed)["calibration"]
    progress("dense calls to learn from", 0, calls.count)
    paths: list[torch.Tensor] = []
    for found in dense_rounds(executor, calls):
        paths.append(found)
        progress("dense calls to learn from", sum(map(len, paths)), calls.count)
    kinds = tuple(block.kind for block in artifact.manifest.blocks)
    # Without constants of a pruner nobody spends time on plans that depend on the observation: schedules are compared.
    return Task(executor, Actions(spec), calls.answered(torch.cat(paths)), len(kinds), seed, {}, kinds)


def _enter(
    artifact: Artifact, found: Mapping[tuple[str, float], Found], others: Mapping[str, Artifact], threads: int
) -> list[Entrant]:
    """Everything that takes part: the artifact's own plans, those of strategies, and those of other artifacts."""
    named = {f"{strategy} {sparsity:g}": one for (strategy, sparsity), one in found.items()}
    corrections = {name: one.correction for name, one in named.items() if one.correction is not None}
    whole = with_plans(artifact, {name: one.schedule for name, one in named.items()}, corrections)
    policy = CompiledPolicy(whole, open_runtime(whole, "onnxruntime", threads))
    entrants = [Entrant("this artifact", name, policy, name, True) for name in (DENSE, *artifact.manifest.plans)]
    for strategy, sparsity in found:
        entrants.append(Entrant(strategy, f"{sparsity:g}", policy, f"{strategy} {sparsity:g}", True))
    sampler = artifact.manifest.spec.sampler
    for name, other in others.items():
        theirs = other.manifest.spec.sampler
        paired = (theirs.stochastic, theirs.name, theirs.steps) == (sampler.stochastic, sampler.name, sampler.steps)
        opened = CompiledPolicy(other, open_runtime(other, "onnxruntime", threads))
        entrants += [Entrant(name, plan, opened, plan, paired) for plan in (DENSE, *other.manifest.plans)]
    return entrants


def _unique(name: str, others: Sequence[Path]) -> str:
    """Name of the folder; refuses two of one name.

    Raises:
        CalibrationError: there are two.
    """
    if sum(other.resolve().name == name for other in others) > 1:
        raise CalibrationError(f"two artifacts are called {name!r}; their points could not be told apart. Rename one.")
    return name


def _require_same_policy(artifact: Artifact, other: Artifact, name: str) -> None:
    """Refuse an artifact that was made from another checkpoint.

    Raises:
        CalibrationError: says what differs.
    """
    ours, theirs = artifact.manifest.spec, other.manifest.spec
    shapes = [
        (s.original.sample, {k: o.shape for k, o in s.observations.items()}, s.chunk.start, s.chunk.stop)
        for s in (ours, theirs)
    ]
    # Masks and position tables are shorter where fewer steps are predicted; the weights proper are not.
    narrower = ours.sample != theirs.sample
    pairs = [(value, other.weights[key]) for key, value in artifact.weights.items() if key in other.weights]
    same = [np.array_equal(left, right) for left, right in pairs]
    excused = [narrower and left.shape != right.shape for left, right in pairs]
    equal = any(same) and all(a or b for a, b in zip(same, excused, strict=True))
    if shapes[0] != shapes[1] or not equal:
        what = f"{shapes[1]} instead of {shapes[0]}" if shapes[0] != shapes[1] else "other weights"
        raise CalibrationError(
            f"{name}: expected an artifact of the same checkpoint; found {what}. Actions of different policies cannot"
            " be held against each other: convert the same checkpoint with another --sampler, --steps or --precision."
        )


def _warnings(artifact: Artifact, split: Split, others: Mapping[str, Artifact]) -> tuple[str, ...]:
    """Plans that may have been learned from the episodes that they are judged on here."""
    found = []
    for name, one in {"this artifact": artifact, **others}.items():
        record = one.manifest.calibration or {}
        held_out = (record.get("episodes") or {}).get("validation")
        if one.manifest.plans and (held_out is None or tuple(held_out) != split.validation):
            found.append(
                f"{name}: its calibration held out the episodes {held_out}, and this comparison"
                f" {list(split.validation)}: its plans may have been learned from them. Give the same files and --seed."
            )
    return tuple(found)
