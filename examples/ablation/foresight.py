"""Can deciding at test time pay, on this policy? The best that any decision could do, before one is built.

Schedules of whole steps, each with a correction of its own, answer calls of episodes that they were not fitted on, each
observation with several draws of noise. ``choosing`` then says what it would be worth to choose among them call by
call, for somebody who knows everything afterwards, and for a predictor that knows what is known before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, islice
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from choosing import Choice, Errors, choices
from three_parts import answered, in_three

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Actions, Calls, load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.progress import Progress
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.task import Array
from ttscompile.calibration.trials import base_of
from ttscompile.core.coercion import integer
from ttscompile.core.correction import MOST_NUMBERS, Correction
from ttscompile.core.lattice import PlanArray, whole_steps_plan
from ttscompile.errors import CalibrationError

FITTED = 384
"""Calls that corrections are fitted on, at most."""


@dataclass(frozen=True)
class Oracle:
    """What was found.

    Attributes:
        budget: computed steps of a call.
        choices: the first one chooses nothing.
        schedules: how many there were to choose from, by their number of computed steps.
        calls: judged: observations, and draws of noise for each.
        episodes: numbers of the episodes that corrections were fitted on, that predictors were learned on, and that
            everything was judged on.
    """

    budget: int
    choices: tuple[Choice, ...]
    schedules: Mapping[int, int]
    calls: tuple[int, int]
    episodes: Mapping[str, tuple[int, ...]]

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {**asdict(self), "schedules": {str(count): number for count, number in self.schedules.items()}}


def oracle(
    path: Path,
    trajectories: Sequence[Path],
    budget: int,
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    schedules: int = 16,
    calls: int = 64,
    draws: int = 4,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> Oracle:
    """Measure what choosing a schedule for each call could gain. Nothing is written.

    Args:
        trajectories: recorded episodes, see ``ttscompile.trajectories``; three at least.
        budget: computed steps of a call.
        observation: see ``ttscompile.calibrate``.
        schedules: to choose from, at most, of ``budget`` computed steps, of one less and of one more each.
        calls: observations to judge on, and as many to learn from, at most.
        draws: of noise for each observation, two at least.
        seed: the seed of the division of the episodes, the calls, the noise and the schedules.

    Raises:
        CalibrationError: arguments out of range, or too few episodes.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: the artifact cannot be opened.
    """
    seed = integer(seed, "seed", CalibrationError)
    sizes = {"schedules": schedules, "calls": calls, "draws": draws}
    schedules, calls, draws = (integer(size, name, CalibrationError, 2) for name, size in sizes.items())
    artifact = load_artifact(path)
    view = view_of(artifact, base_of(artifact).exact)
    spec, steps, blocks = view.manifest.spec, view.manifest.steps, len(view.manifest.blocks)
    if steps < 3:
        told = f"the policy has {steps} denoising step{'s' * (steps > 1)}; expected three at least"
        raise CalibrationError(f"{told}: with fewer there is nothing to choose. Convert with more denoising steps.")
    if not 1 < integer(budget, "computed steps", CalibrationError) < steps:
        raise CalibrationError(f"computed steps: expected between 2 and {steps - 1} of {steps}; found {budget}.")
    episodes = load_episodes(spec, trajectories, observation)
    if len(episodes) < 3:
        raise CalibrationError(
            f"the trajectories hold {len(episodes)} episodes; expected three at least: corrections are fitted on some,"
            " choices learned on others, and judged on others again. Record more; about sixteen are enough."
        )
    fitting, learning, judging = in_three(len(episodes), seed)
    runner, actions = Runner(view), Actions(spec)

    def drawn(numbers: tuple[int, ...], stage: int) -> Calls:
        """Observations of some episodes, each with all of its draws, one after the other."""
        chosen = [one for one in sample_calls(episodes, numbers, calls, seed) for _ in range(draws)]
        return prepare_calls(runner.model, spec, episodes, chosen, (seed, 7, stage))

    repeated = sample_calls(episodes, fitting, FITTED, seed, REPEATS)
    fitted = prepare_calls(runner.model, spec, episodes, repeated, (seed, 7, 0))
    fitted = answered(runner, fitted, "dense calls for corrections", progress)
    parts = [
        answered(runner, drawn(numbers, stage), f"dense calls to {what}", progress)
        for stage, (what, numbers) in enumerate({"learn from": learning, "judge": judging}.items(), 1)
    ]

    def wrong(plan: PlanArray, correction: Correction | None, part: Calls) -> Array:
        return actions.errors(runner.corrected(correction).run(plan, part), part.targets, units=True)

    counts = [count for count in (budget - 1, budget, budget + 1) if 0 < count < steps]
    placed = [one for count in counts for one in placements(steps, count, schedules, seed)]
    errors: list[list[Array]] = [[], []]
    for number, one in enumerate(placed):
        progress("schedules", number, len(placed))
        plan = whole_steps_plan(steps, blocks, one)
        # As calibration decides for most policies; what does harm is left out.
        made = [fit_correction(runner, plan, fitted, reads) for reads in (True, False)]
        tried = [(wrong(plan, each, parts[0]), each) for each in (*made, None)]
        best, correction = min(tried, key=lambda pair: float(pair[0].mean()))
        errors[0].append(best)
        errors[1].append(wrong(plan, correction, parts[1]))
    progress("schedules", len(placed), len(placed))
    learned, judged = (_errors(runner, part, each, draws) for part, each in zip(parts, errors, strict=True))
    computed = np.array([len(one) for one in placed])
    return Oracle(
        budget=budget,
        choices=tuple(choices(learned, judged, computed, budget, seed)),
        schedules={count: int((computed == count).sum()) for count in counts},
        calls=(len(judged.of), draws),
        episodes={"corrections": fitting, "learned": learning, "judged": judging},
    )


def placements(steps: int, count: int, most: int, seed: int) -> list[tuple[int, ...]]:
    """Schedules that compute ``count`` of the steps, step 0 among them: all, or crowded ones and others at random."""
    if comb(steps - 1, count - 1) <= most:
        return [(0, *rest) for rest in combinations(range(1, steps), count - 1)]
    found = dict.fromkeys(islice(spacings(steps, count), most))
    draw = np.random.default_rng((seed, 8, count))
    while len(found) < most:
        found[(0, *sorted(int(k) for k in draw.choice(np.arange(1, steps), count - 1, replace=False)))] = None
    return list(found)


def _errors(runner: Runner, calls: Calls, columns: Sequence[Array], draws: int) -> Errors:
    """The errors of all schedules on calls, of which so many in a row have one observation."""
    assert calls.path is not None
    condition = runner.model.condition(calls.contexts)
    known = {
        **({"the observation": condition} if 0 < condition.shape[1] <= MOST_NUMBERS else {}),
        "the noise": calls.initial.flatten(1),
        "the sample after step 0": calls.path[:, 0].flatten(1),
    }

    def grouped(array: Array) -> Array:
        return array.reshape(len(array) // draws, draws, -1).astype(np.float64)

    return Errors(
        grouped(np.stack(columns, 1)),
        calls.episodes[::draws],
        {name: grouped(tensor.numpy()) for name, tensor in known.items()},
    )
