"""Schedules that share their first computed steps, each with a correction, on calls of episodes of three kinds.

Calibration's own search finds the fixed schedules, and its own least squares fit every correction. What differs is only
that all answers are kept, and that schedules which begin as good ones do are tried beside them: ``deciding`` has to
choose among endings of one beginning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from deciding import Array, Family, Fixed, Row, Steps, best_family, decided
from three_parts import answered, in_three

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import Actions, Calls, load_episodes, prepare_calls, sample_calls
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.progress import Progress
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.sparse_loop import SparseLoop
from ttscompile.calibration.step_counts import spacings
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.task import Task
from ttscompile.calibration.trials import base_of
from ttscompile.calibration.tts import Tts
from ttscompile.calibration.whole_steps import Errors, ScheduleRuns, WholeSteps
from ttscompile.core.coercion import integer
from ttscompile.core.correction import Correction, may_jump
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.errors import CalibrationError

BEGINNINGS = (2, 3)
"""Computed steps that schedules of a family share."""

GOOD = 2
"""Schedules of each number of computed steps whose beginnings are tried with other endings."""

SEARCHING = 0.5
"""Share of the time that the search of fixed schedules gets."""


@dataclass(frozen=True)
class Decided:
    """What was found for a mean number of evaluations.

    Attributes:
        evaluations: that a call may need on average.
        family: of nested schedules.
        rows: fixed schedules, then what the family does by its estimate, by chance, and after the fact.
    """

    evaluations: float
    family: Family
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Nested:
    """What was found.

    Attributes:
        fixed: the best of all schedules that were tried, by their number of computed steps.
        rows: of these.
        decided: without going back to before the last computed step, and with it.
        calls: that corrections were fitted on, that schedules and thresholds were learned on, and judged.
        episodes: numbers of the episodes of these.
        tried: schedules.
        jumps: whether corrections have jumps.
    """

    fixed: Mapping[int, Steps]
    rows: tuple[Row, ...]
    decided: tuple[Decided, ...]
    calls: tuple[int, int, int]
    episodes: Mapping[str, tuple[int, ...]]
    tried: int
    jumps: bool

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {**asdict(self), "fixed": {str(count): steps for count, steps in self.fixed.items()}}


class Kept(WholeSteps):
    """Compares schedules as calibration does, and keeps what they answer."""

    def __init__(self, runner: Runner, actions: Actions, fitted: Calls, learned: Calls, count: int, seed: int):
        super().__init__(runner, fitted, seed)
        self.reading = self.reads(count)
        self._kept: dict[Steps, torch.Tensor] = {}
        self._actions_of, self._learned = actions, learned
        loop = SparseLoop(runner, fitted, learned, reads=self.reading, whole=True)
        self._loop = ScheduleRuns(loop, self.steps, runner.model.blocks)

    def errors(self, steps: Sequence[int]) -> Errors:
        """See ``WholeSteps``; of corrections that are fitted on one part of the episodes, on another."""
        samples = self.answer(tuple(steps))
        made = (self._actions_of.errors(samples, self._learned.targets, units=units).mean() for units in (False, True))
        return Errors(*map(float, made))

    def expect(self, schedules: Iterable[tuple[int, ...]]) -> None:
        """Nothing is known before it is asked for."""

    def correction(self, steps: Sequence[int]) -> Correction | None:
        """None: what a search settles on is fitted later."""
        return None

    def answer(self, steps: Steps) -> torch.Tensor:
        """Of the calls learned from, ``[N, T, D]``."""
        if steps not in self._kept:
            self._kept[steps] = self._loop.end(steps).samples
        return self._kept[steps]

    @property
    def answers(self) -> Mapping[Steps, torch.Tensor]:
        """Of all schedules that were tried."""
        return self._kept


def nested(
    path: Path,
    trajectories: Sequence[Path],
    evaluations: Sequence[float] = (3.0, 4.0),
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    most: int = 6,
    fitted: int = 384,
    learned: int = 384,
    judged: int = 400,
    minutes: float = 10.0,
    jumps: bool = False,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> Nested:
    """Measure what deciding on the way gains over fixed schedules. Nothing is written.

    Args:
        trajectories: recorded episodes, see ``ttscompile.trajectories``; four at least.
        evaluations: of the network in a call, on average.
        observation: see ``ttscompile.calibrate``.
        most: computed steps of a call, at most.
        fitted: calls that corrections are fitted on, at most.
        learned: calls, of other episodes, on which schedules and thresholds are chosen, at most.
        judged: calls, of other episodes again, at most.
        minutes: of searching.
        jumps: whether corrections of the schedules that are judged have jumps.
        seed: of the division of the episodes, the calls and the noise.

    Raises:
        CalibrationError: arguments out of range, or too few episodes.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: the artifact cannot be opened.
    """
    seed = integer(seed, "seed", CalibrationError)
    artifact = load_artifact(path)
    view = view_of(artifact, base_of(artifact).exact)
    spec, steps = view.manifest.spec, view.manifest.steps
    most = min(integer(most, "computed steps", CalibrationError, 3), steps - 1)
    if not all(2 < one < most for one in evaluations):
        raise CalibrationError(
            f"evaluations: expected numbers above 2 and below {most}, the computed steps of a call at most; found"
            f" {', '.join(f'{one:g}' for one in evaluations)}."
        )
    episodes = load_episodes(spec, trajectories, observation)
    if len(episodes) < 4:
        raise CalibrationError(
            f"the trajectories hold {len(episodes)} episodes; expected four at least: corrections are fitted on some,"
            " thresholds learned on others, and judged on others again. Record more; about sixty are enough."
        )
    fitting, learning, judging = in_three(len(episodes), seed)
    runner, actions = Runner(view), Actions(spec)

    def dense(numbers: Sequence[tuple[int, int]], what: str, stage: int) -> Calls:
        calls = prepare_calls(runner.model, spec, episodes, numbers, (seed, 10, stage))
        return answered(runner, calls, what, progress)

    drawn = [
        sample_calls(episodes, numbers, limit, seed, REPEATS)
        for numbers, limit in ((fitting, fitted), (learning, learned), (judging, judged))
    ]
    fit = dense(drawn[0], "dense calls for corrections", 0)
    others = dense([*drawn[1], *drawn[2]], "dense calls to compare on", 1)
    learn, judge = (runner.select(others, one) for one in np.split(np.arange(others.count), [len(drawn[1])]))
    clock = Clock(60 * minutes)
    whole = Kept(runner, actions, fit, learn, min(3, most), seed)
    task = replace(Task.of(runner, fit, 0, seed), whole=whole)
    _search(task, most, clock.until(SEARCHING), progress)
    _endings(whole, most, clock, progress)
    fixed = {count: _ranked(whole, count)[0] for count in range(2, most + 1)}

    def error(samples: torch.Tensor, calls: Calls) -> Array:
        return actions.errors(samples, calls.targets, units=True).astype(np.float64)

    def apart(one: torch.Tensor, other: torch.Tensor) -> Array:
        return actions.errors(one, other, units=False).astype(np.float64)

    errors = {one: error(samples, learn) for one, samples in whole.answers.items()}
    families = [
        (number, family)
        for number in evaluations
        for returns in (False, True)
        if (
            family := best_family(
                errors, lambda at: apart(whole.answers[at], whole.answers[at[:-1]]), number, most, returns
            )
        )
    ]
    needed = {*fixed.values()}
    needed |= {one for _, family in families for one in (family.at, family.at[:-1], *family.endings)}
    answers = dict(_answers(runner, fit, others, sorted(needed), whole.reading, jumps, progress))
    of_judged = {one: error(samples[learn.count :], judge) for one, samples in answers.items()}
    best = Fixed({count: of_judged[one] for count, one in fixed.items()}, judge.episodes, seed)

    def estimates(at: Steps) -> tuple[Array, Array]:
        every = apart(answers[at], answers[at[:-1]])
        return every[: learn.count], every[learn.count :]

    made = []
    for number, family in families:
        rows = decided(family, of_judged, estimates(family.at), best)
        made.append(Decided(number, family, (best.mixed(rows[0].evaluations), *rows)))
    return Nested(
        fixed=fixed,
        rows=tuple(best.rows()),
        decided=tuple(made),
        calls=(fit.count, learn.count, judge.count),
        episodes={"corrections": fitting, "learned": learning, "judged": judging},
        tried=len(whole.answers),
        jumps=jumps,
    )


def _search(task: Task, most: int, clock: Clock, progress: Progress) -> None:
    """Try the schedules that calibration tries, of each number of computed steps from 2 on."""
    for count in range(2, most + 1):
        progress("fixed schedules", count - 2, most - 1)
        share = clock.until((clock.elapsed() + clock.left() / (most + 1 - count)) / clock.limit)
        search_plan(Tts(replace(task, budget=count * task.runner.model.blocks, clock=share)), share)
    progress("fixed schedules", most - 1, most - 1)


def _ranked(whole: Kept, count: int) -> list[Steps]:
    """All schedules of so many computed steps that were tried, the best first."""
    return sorted((one for one in whole.answers if len(one) == count), key=lambda one: whole.errors(one).normalised)


def _endings(whole: Kept, most: int, clock: Clock, progress: Progress) -> None:
    """Try schedules that begin as good ones do, and all beginnings alone, as long as there is time."""
    beginnings: dict[Steps, None] = {}
    for count in range(2, most + 1):
        for one in _ranked(whole, count)[:GOOD]:
            beginnings.update(dict.fromkeys(one[:length] for length in BEGINNINGS if length <= count))
    coming = list(dict.fromkeys(_continued(whole.steps, beginnings, most)))
    for number, steps in enumerate(clock.in_time(coming)):
        progress("endings", number, len(coming))
        whole.answer(steps)
    # Compared are answers with and without the last step.
    for steps in sorted({one[:length] for one in whole.answers for length in range(1, len(one))}):
        whole.answer(steps)


def _continued(steps: int, beginnings: Iterable[Steps], most: int) -> Iterator[Steps]:
    """All beginnings with as many more steps, evenly or crowded, for each number of steps in turn."""
    every = list(beginnings)
    for count in range(1, most):
        for one in every:
            if count <= min(most - len(one), steps - 1 - one[-1]):
                for spaced in spacings(steps - one[-1], count + 1):
                    yield one + tuple(one[-1] + step for step in spaced[1:])


def _answers(
    runner: Runner,
    fitted: Calls,
    others: Calls,
    schedules: Sequence[Steps],
    reads: bool,
    jumps: bool,
    progress: Progress,
) -> Iterator[tuple[Steps, torch.Tensor]]:
    """What schedules answer to calls that their corrections were not fitted on, ``[N, T, D]``.

    Schedules that begin alike have the same corrections and jumps up to where they part.
    """
    model = runner.model
    jumps = jumps and may_jump(runner.view.manifest.spec.sample)
    loop = SparseLoop(runner, fitted, others, reads=reads, whole=True)
    runs = ScheduleRuns(loop, model.steps, model.blocks)
    for number, steps in enumerate(schedules):
        progress("judged schedules", number, len(schedules))
        place = loop.ends(whole_steps_plan(model.steps, model.blocks, steps))[1] if jumps else runs.end(steps)
        yield steps, place.samples
    progress("judged schedules", len(schedules), len(schedules))
