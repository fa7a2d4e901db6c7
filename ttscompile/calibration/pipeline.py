"""Calibration, as one straight line: episodes -> calls -> targets -> strategy -> judgement -> artifact."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..artifact.load import Artifact, load_artifact
from ..artifact.write import update_calibration
from ..errors import CalibrationError
from ..lattice import sparsity
from ..trajectories import Episode, load_trajectories
from .calls import Actions, Calls, prepare_calls, sample_calls, split_episodes
from .execute import Executor
from .judge import PRUNED, SCHEDULE, UNIFORM, judge, require_success, uniform_of
from .progress import Bar
from .result import CalibrationResult, PlanScore
from .state import StateFile
from .strategies import Found, Strategy, Task, open_strategy, require_strategy

CALLS_A_MINUTE = 16
"""Calls to learn from, for each minute of the time limit; half as many again are judged on."""

FEWEST_CALLS, MOST_CALLS = 32, 192

CLOSING_SHARE = 0.3
"""What a strategy does at the end is left out where it would take more than this share of the time: on Push-T an
interval of search lowers the error by 3 to 30 %, the switches by a few."""

TARGETS_AT_ONCE = 16
"""Dense calls between two states: a few seconds."""


def calibrate(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]],
    target_sparsity: float = 0.95,
    strategy: str = "tts",
    seed: int = 0,
    resume: bool = False,
    *,
    max_minutes: float = 15.0,
    validation_fraction: float = 0.25,
    max_intervals: int | None = None,
    progress: bool = True,
) -> CalibrationResult:
    """Learn which residuals an artifact can reuse, from a few recorded episodes, and write the plans into it.

    Targets come from the dense policy with the same noise. Plans are judged on episodes that they were not learned
    from. After every interval of some seconds the state is saved in the artifact's directory: whatever stops the
    process, a call with ``resume`` goes on from there, and ends where it would have ended. The same arguments give the
    same bytes, unless the time limit cuts the search short.

    Args:
        path: the artifact's directory.
        trajectories: ``.npz`` files, see ``ttscompile.trajectories``.
        target_sparsity: share of the cells to reuse.
        strategy: ``tts`` learns; ``interval`` is the uniform schedule.
        seed: of the split, the noise and the search.
        resume: go on where a calibration with the same arguments was interrupted; begins anew if none was.
        max_minutes: after this time the best plan so far is taken. Also decides how many calls are used.
        validation_fraction: of the episodes.
        max_intervals: an end that does not depend on the machine's speed; None for the strategy's own.
        progress: show a bar on standard error.

    Returns:
        What was achieved.

    Raises:
        CalibrationFailedError: the target was not reached, or the plan is no better than the uniform schedule of the
            same sparsity. The artifact is as it was.
        CalibrationError: the arguments cannot be satisfied, or there is nothing to resume with these.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: no artifact, or it cannot be written.
    """
    begun = time.monotonic()
    artifact = load_artifact(Path(path))
    spec = artifact.manifest.spec
    if not Path(path).is_dir():
        raise CalibrationError(
            f"{path}: only a directory can be calibrated. Unzip the artifact and give the directory."
        )
    require_strategy(strategy)
    budget = _budget(artifact, target_sparsity, validation_fraction, max_minutes)
    episodes = load_trajectories(trajectories, spec.observations, spec.chunk.stop - spec.chunk.start)
    if len(episodes) < 2:
        raise CalibrationError(
            "the trajectories hold one episode; expected at least two: a plan is judged on episodes that it was not"
            " learned from. Record more; about sixteen are enough."
        )
    split = split_episodes(len(episodes), validation_fraction, seed)
    executor = Executor(artifact)
    limit = int(np.clip(CALLS_A_MINUTE * max_minutes, FEWEST_CALLS, MOST_CALLS))
    sets = {}
    for number, (name, chosen, count) in enumerate(
        (("calibration", split.calibration, limit), ("validation", split.validation, limit // 2))
    ):
        drawn = sample_calls(episodes, chosen, count, seed)
        sets[name] = prepare_calls(executor.model, spec, episodes, drawn, (seed, 2, number))
    state = StateFile(
        Path(path),
        {
            "model": artifact.manifest.model_identity[:16],
            "trajectories": _digest(episodes),
            "target_sparsity": target_sparsity,
            "strategy": strategy,
            "seed": seed,
            "validation_fraction": validation_fraction,
            "calls": limit,
            "max_intervals": max_intervals,
        },
    )
    if not (resume and state.load()):
        state.remove()
    clock = _Clock(begun, float(state.progress.get("seconds", 0.0)), 60 * max_minutes)
    with Bar(progress) as bar:
        sets = {name: _with_targets(executor, name, calls, state, clock, bar) for name, calls in sets.items()}
        task = Task(executor, Actions(spec), sets["calibration"], budget, seed, artifact.pruner)
        found, intervals, stopped = _search(open_strategy(strategy, task), state, clock, bar, max_intervals)
    scores = judge(artifact, executor, found, sets["validation"], budget)
    result = CalibrationResult(
        strategy=strategy,
        seed=seed,
        target_sparsity=target_sparsity,
        default_plan=_default(scores, target_sparsity),
        plans=scores,
        episodes={"calibration": split.calibration, "validation": split.validation},
        calls={name: calls.count for name, calls in sets.items()},
        intervals=intervals,
        stopped=stopped,
        seconds=clock.elapsed(),
    )
    require_success(result, found.is_baseline)
    update_calibration(
        path,
        found.pruner,
        {SCHEDULE: found.schedule, UNIFORM: uniform_of(artifact, budget)},
        result.default_plan,
        {**result.record(), **found.notes},
        model_identity=artifact.manifest.model_identity,
    )
    state.remove()
    return result


def _default(scores: Mapping[str, PlanScore], target: float) -> str:
    """The pruner's plans if they are no worse than the schedule on the held-out calls, and as sparse as was asked."""
    pruned = scores.get(PRUNED)
    if pruned is None or pruned.sparsity < target - 1e-9 or pruned.error > scores[SCHEDULE].error:
        return SCHEDULE
    return PRUNED


class _Clock:
    """Seconds of work, the parts before an interruption included."""

    def __init__(self, begun: float, before: float, limit: float) -> None:
        self._begun, self._before, self.limit = begun, before, limit

    def elapsed(self) -> float:
        return time.monotonic() - self._begun + self._before


def _budget(artifact: Artifact, target: float, fraction: float, minutes: float) -> int:
    """How many cells a plan may compute."""
    steps, blocks = artifact.manifest.steps, len(artifact.manifest.blocks)
    if not 0 < fraction < 1 or not minutes > 0:
        raise CalibrationError(
            f"expected validation_fraction between 0 and 1 and max_minutes above 0; found {fraction} and {minutes}."
        )
    budget = int((1 - target) * steps * blocks + 1e-6) if 0 <= target < 1 else 0
    if budget < blocks:
        raise CalibrationError(
            f"target sparsity {target:g} cannot be reached: step 0 of every call is dense, so at most"
            f" {1 - 1 / steps:.4g} of the {steps} x {blocks} cells can be reused. Lower the target, or convert with"
            " more denoising steps."
        )
    return budget


def _digest(episodes: Sequence[Episode]) -> str:
    digest = hashlib.sha256()
    for episode in episodes:
        for key, array in sorted(episode.observations.items()):
            digest.update(f"{key} {array.dtype} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _with_targets(executor: Executor, name: str, calls: Calls, state: StateFile, clock: _Clock, bar: Bar) -> Calls:
    """The calls with what the dense policy answers to them."""
    known = state.get("targets").get(name)
    targets = calls.targets if known is None else torch.from_numpy(known)
    bar.stage(f"dense, {name}", calls.count, len(targets))
    while len(targets) < calls.count:
        numbers = np.arange(len(targets), min(len(targets) + TARGETS_AT_ONCE, calls.count))
        targets = torch.cat([targets, executor.run_dense(executor.selector.calls(calls, numbers))])
        state.put("targets", {**state.get("targets"), name: targets.numpy()})
        state.progress["seconds"] = clock.elapsed()
        state.save()
        bar.update(len(targets), "", clock.limit - clock.elapsed())
    return replace(calls, targets=targets)


def _search(search: Strategy, state: StateFile, clock: _Clock, bar: Bar, most: int | None) -> tuple[Found, int, str]:
    """Intervals until the strategy is done, or the time is up; what it found, how many, and why it stopped."""
    count = search.intervals if most is None else min(most, search.intervals)
    first = int(state.progress.get("intervals", 0))
    if first:
        search.restore(state.get("strategy"))
    bar.stage("search", count, first)
    number, longest, cut = first, 0.0, False
    while number < count and not search.done:
        start = clock.elapsed()
        if number > 0 and start + longest > clock.limit:
            return search.found(), number, "time limit"
        closing = search.closing * longest
        if number > 0 and closing <= CLOSING_SHARE * clock.limit and start + longest + closing > clock.limit:
            search.close()
            cut = True
        search.advance(number)
        number += 1
        longest = max(longest, clock.elapsed() - start)
        state.put("strategy", search.state())
        state.progress.update(intervals=number, seconds=clock.elapsed())
        state.save()
        left = min(clock.limit - clock.elapsed(), (count - number) * longest)
        bar.update(number, f"error {search.loss:.4f}, sparsity {sparsity(search.plan):.2%}", left)
    return search.found(), number, "time limit" if cut else "converged" if search.done else "finished"
