"""Schedules that are proposed now, to take part in a comparison; what was found is kept, so that it can go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from equal_time import Pace, largest

from ttscompile.calibration.arguments import CallLimits
from ttscompile.calibration.budget import cells_of, goal_of
from ttscompile.calibration.calls import Calls, digest_of
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.compare import Entrant, Joining
from ttscompile.calibration.progress import Progress
from ttscompile.calibration.proposer import ScheduleRow
from ttscompile.calibration.proposers import SCHEDULES
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.schedule import search_plan
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.targets import runner_arguments, runner_elsewhere
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import HELD_OUT, Trials
from ttscompile.core.correction import FEATURES, Correction
from ttscompile.core.lattice import check_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import CalibrationError
from ttscompile.pool import Work, opened_pool

LEARNED = 256
"""Calls that searches learn from, at most. ``calibrate`` takes more: its corrections are better."""

Outcome = dict[str, tuple[Found, bool] | str]
"""By series: what was found and whether the time cut that short, or why there is nothing."""

Wish = tuple[str, int]
"""A proposer, and how many cells its plan may compute."""

How = tuple[int | None, float, bool]
"""Intervals at most, seconds of a search, and whether its plan takes part with a correction too."""

_FIELDS = tuple(field.name for field in fields(Correction) if not field.kw_only)
"""Those of calls without a prefix, which plans are compared on."""


class ComparisonState(StateFile):
    """What a comparison has done so far, in the directory of the artifact; nothing is kept where that cannot be.

    Attributes:
        warning: why nothing is kept; empty where something is.
    """

    WORK, AGAIN = "comparison", "Compare"

    def __init__(self, artifact: Path, settings: Mapping[str, Any]) -> None:
        super().__init__(artifact if artifact.is_dir() else None, settings)
        self.warning = "" if artifact.is_dir() else "its artifact is no directory"

    def save(self, **progress: Any) -> None:
        """Write everything, at once or not at all; where that fails nothing is kept from here on."""
        try:
            super().save(**progress)
        except CalibrationError as error:
            self.warning, self._path = str(error), None


class Searches:
    """What is known before a search begins, and what it finds.

    Attributes:
        shares: of a pace that plans take, by pace, series and cells.

    Args:
        state: of the comparison.
        shape: K and number of blocks.

    Raises:
        CalibrationError: what is there is damaged.
    """

    def __init__(self, state: StateFile, shape: tuple[int, int]) -> None:
        self._state, self._shape = state, shape
        with state.reading():
            self._told: dict[str, Any] = state.progress.setdefault("searches", {})
            if not isinstance(self._told, dict) or not all(isinstance(each, dict) for each in self._told.values()):
                raise ValueError("expected searches by name")
            self.shares: dict[str, float] = state.progress.setdefault("shares", {})

    def known(self, name: str, cells: int) -> Outcome | None:
        """What a search found before; None if it was not done."""
        key, outcome = f"{name} {cells}", Outcome()
        with self._state.reading():
            told = self._told.get(key)
            if told is None:
                return None
            for series, one in told.items():
                if isinstance(one, str):
                    outcome[series] = one
                    continue
                arrays = self._state.get(f"{key}/{series}")
                correction = Correction(*(arrays[name] for name in _FIELDS)) if _FIELDS[0] in arrays else None
                schedule = check_plan(arrays["schedule"], *self._shape, 1)[0]
                outcome[series] = (
                    Found(schedule, dict(one["notes"]), correction, error=float(one["error"])),
                    bool(one["cut"]),
                )
        return outcome

    def known_of(self, wish: Wish) -> Outcome:
        """The same, of a search that was done."""
        return self.known(*wish) or {}

    def keep(self, name: str, cells: int, outcome: Outcome) -> None:
        """Keep what a search found."""
        key, told = f"{name} {cells}", dict[str, Any]()
        for series, one in outcome.items():
            if isinstance(one, str):
                told[series] = one
                continue
            found, cut = one
            told[series] = {"notes": dict(found.notes), "error": found.error, "cut": cut}
            correction = {} if found.correction is None else {name: getattr(found.correction, name) for name in _FIELDS}
            self._state.put(f"{key}/{series}", {"schedule": found.schedule, **correction})
        self._told[key] = told
        self.save()

    def save(self) -> None:
        """Keep all of it."""
        self._state.save()


class Searching:
    """Has each proposer find a plan for each sparsity, and lets these take part: see ``calibration.compare.Joining``.

    Attributes:
        plans: those that took part, by ``NAME-SHARE``, or ``NAME-corrected-SHARE``.
        shares: of its pace that each of them takes, by series and pace; empty where they keep none.

    Args:
        path: the artifact; what is done is kept in its directory until ``forget``.
        learn: names of those that find plans; of ``SCHEDULES``.
        sparsities: shares of the cells to reuse.
        learned: calls that searches learn from, at most.
        intervals: of a search, at most; None for its own number.
        max_minutes: of a search, about: what it has found by then takes part, and a warning says so. Who
            has no plan within the budget by then is left out.
        paces: in place of sparsities: of each the largest budget takes part whose plan keeps the pace.
        correct: let the plans of those that fit no correction take part a second time, with one that is fitted to
            them, where that is better. Their series are called ``NAME, corrected``.
        ray: address of a Ray cluster that answers the dense calls and does the searches, or ``local``, see
            ``ttscompile.calibrate``. None does everything here.
        resume: go on after the searches that an interrupted comparison had done, with the same arguments but for
            names, sparsities, other artifacts and held-out calls; begins anew if none was.
    """

    def __init__(
        self,
        path: Path,
        learn: Sequence[str],
        sparsities: Sequence[float],
        *,
        learned: int = LEARNED,
        intervals: int | None = None,
        max_minutes: float = 3.0,
        paces: Callable[[Trials], Sequence[Pace]] | None = None,
        correct: bool = False,
        ray: str | None = None,
        resume: bool = False,
    ) -> None:
        self._path, self._ray, self._resume = path, ray, resume
        self._rows, self._sparsities = [row_of(name) for name in learn], sparsities
        self._paces = paces or (lambda trials: ())
        self._timed = paces is not None
        self._learned, self._minutes, self._how = learned, max_minutes, (intervals, 60 * max_minutes, correct)
        self._state: ComparisonState | None = None
        self.plans: dict[str, Plan] = {}
        self.shares: dict[str, dict[str, float]] = {}

    def forget(self) -> None:
        """Keep nothing any more: the comparison is done."""
        if self._state is not None:
            self._state.remove()

    def __call__(self, trials: Trials, progress: Progress) -> Joining:
        """The plans.

        Raises:
            ClusterError: the cluster cannot be reached, or is gone; what was done before can be resumed.
            CalibrationError: a sparsity that nothing reaches, or nothing to resume with these arguments.
        """
        intervals, _, correct = self._how
        settings = {
            "model": trials.artifact.manifest.model_identity[:16],
            "trajectories": digest_of(trials.episodes),
            "seed": trials.seed,
            "learned": self._learned,
            "intervals": intervals,
            "max_minutes": self._minutes,
            "correct": correct,
        }
        state = self._state = ComparisonState(self._path, settings)
        manifest = trials.runner.view.manifest
        budgets = {one: cells_of(goal_of(target_sparsity=one), manifest, False) for one in self._sparsities}
        with opened_pool(self._ray) as pool:
            trials = replace(trials, state=state, pool=pool, limits=CallLimits(*[self._learned] * 3))
            if not (self._resume and state.load()):
                state.remove()
            searches = Searches(state, (manifest.steps, len(manifest.blocks)))
            search = partial(self._search, trials, searches, progress)
            wished = [((one.name, cells), f"{sparsity:g}") for one in self._rows for sparsity, cells in budgets.items()]
            search(dict(wished))
            trials.sample(HELD_OUT)  # answered by the pool, and kept
            found = [(series, name, one) for wish, name in wished for series, one in searches.known_of(wish).items()]
            for pace in self._paces(trials):
                for row in self._rows:
                    for series, one, share in _at_pace(pace, row, searches, search):
                        found.append((series, pace.name, one))
                        if share is not None:
                            self.shares.setdefault(series, {})[pace.name] = share
        entrants, skipped, cut = list[Entrant](), dict[str, str](), list[str]()
        for series, name, one in found:
            if isinstance(one, str):
                skipped[f"{series} {name}"] = one
                continue
            plan, short = one
            made = replace(trials.base, cells=plan.schedule, correction=plan.correction)
            entrants.append(Entrant(series, name, trials, made))
            self.plans[f"{series.replace(', ', '-')}-{name}"] = made
            cut += [f"{series} {name}"] * short
        warnings = [f"nothing was kept for --resume: {state.warning}."] if found and state.warning else []
        if cut:
            limit = f"the limit of {self._minutes:g} minutes"
            warnings.append(f"{limit} cut the search short of {', '.join(cut)}: see --max-minutes.")
        warnings += self._remarks(manifest.steps, FEATURES * manifest.spec.sample[0])
        return Joining(entrants, skipped, warnings)

    def _search(self, trials: Trials, searches: Searches, progress: Progress, names: Mapping[Wish, str]) -> None:
        """Have those of these searches done that are not known."""
        missing = [wish for wish in names if searches.known(*wish) is None]
        if not missing:
            return
        progress("dense calls to learn from", 0, 1)
        task = _of_schedules(trials.runner, trials.calls, trials.seed)
        given = *runner_arguments(trials.runner), trials.calls, trials.seed, self._how
        outcomes = trials.pool.map(Work(partial(_searched, task, self._how), _searched_elsewhere, given), missing)
        for number, wish in enumerate(missing, len(names) - len(missing)):
            progress(f"search: {wish[0]} {names[wish]}", number, len(names))
            searches.keep(*wish, next(outcomes))
        progress("search", len(names), len(names))

    def _remarks(self, steps: int, features: int) -> list[str]:
        """What a reader has to know of those that take part."""
        found = []
        if self._rows and not (self._sparsities or self._timed):
            found.append(f"no proposer takes part: no share of the cells was given for K = {steps}.")
        if pruning := [one.name for one in self._rows if one.uses_pruner]:
            found.append(
                f"{', '.join(pruning)}: one plan for all calls takes part, of independent calls. What depends on the"
                " observation is found by 'calibrate', after which it is among the plans of the artifact."
            )
        fitted = [one.name for one in self._rows if one.corrects]
        if fitted and self._learned < features:
            found.append(
                f"{', '.join(fitted)} fits corrections of {features} features from at most {self._learned} calls: its"
                " points are far worse than they would be after a calibration. Let it learn from more."
            )
        return found


def row_of(name: str) -> ScheduleRow:
    """The proposer of schedules of this name. Raises CalibrationError: there is none."""
    for row in SCHEDULES:
        if row.name == name:
            return row
    raise CalibrationError(
        f"{name!r} proposes no schedules; expected one of {', '.join(one.name for one in SCHEDULES)}."
    )


def plan_of(name: str, task: Task, intervals: int | None = None, seconds: float = math.inf) -> tuple[Found, bool]:
    """What a search finds, whether or not it is any better than the uniform schedule.

    Args:
        name: of the proposer.
        task: see ``Task``; its clock is not used.
        intervals: how many at most; None for its own number.
        seconds: after which nothing more is begun that can be left out.

    Returns:
        What was found, and whether the time cut the search short.

    Raises:
        CalibrationError: there is no such proposer, or it cannot keep the budget.
        CalibrationFailedError: the time was up before there was a plan within the budget.
    """
    clock = Clock(seconds)
    found, _, stopped = search_plan(row_of(name).search(replace(task, clock=clock)), clock, intervals)
    return found, stopped == "time limit"


def _at_pace(
    pace: Pace, row: ScheduleRow, searches: Searches, search: Callable[[Mapping[Wish, str]], None]
) -> list[tuple[str, tuple[Found, bool] | str, float | None]]:
    """Of each series of a proposer what keeps the pace with the largest budget, and its share; or why there is none."""
    model, base = pace.trials.runner.model, pace.trials.base
    kept: list[tuple[str, tuple[Found, bool] | str, float | None]] = []

    def found(series: str, cells: int) -> tuple[Found, bool] | str:
        search({(row.name, cells): f"of {cells} cells"})
        return searches.known_of((row.name, cells)).get(series, "it finds nothing with fewer cells.")

    def share(series: str, cells: int) -> float:
        one, key = found(series, cells), f"{pace.name} {series} {cells}"
        if isinstance(one, str):
            return math.inf
        if key not in searches.shares:
            plan = replace(base, cells=one[0].schedule, correction=one[0].correction)
            searches.shares[key] = pace.share(plan)
            searches.save()
        return searches.shares[key]

    search({(row.name, pace.cells): f"of {pace.cells} cells"})
    for series, most in searches.known_of((row.name, pace.cells)).items():
        if isinstance(most, str):  # nor is there anything for fewer cells
            kept.append((series, most, None))
            continue
        least = row.least(model.steps, model.blocks)
        near = model.blocks // (1 if row.corrects else 2)  # it computes whole steps alone
        budget, tried = largest(partial(share, series), least, pace.cells, near)
        if budget is None:
            fewest = min(tried)
            told = f"with {fewest} cells a call takes {tried[fewest]:.3g} times as long as it may."
            kept.append((series, told, None))
        else:
            kept.append((series, found(series, budget), tried[budget]))
    return kept


def _searched(task: Task, how: How, wish: Wish) -> Outcome:
    """What a search finds for so many cells."""
    (name, cells), (intervals, seconds, correct) = wish, how
    try:
        found, short = plan_of(name, replace(task, budget=cells), intervals, seconds)
    except CalibrationError as error:
        return {name: str(error)}
    outcome: Outcome = {name: (found, short)}
    if correct and not row_of(name).corrects:
        try:
            outcome[f"{name}, corrected"] = task.corrected(found), False
        except CalibrationError as error:
            outcome[f"{name}, corrected"] = str(error)
    return outcome


def _searched_elsewhere(
    path: str, identity: str, loop: str, calls: Calls, seed: int, how: How
) -> Callable[[Wish], Outcome]:
    return partial(_searched, _of_schedules(runner_elsewhere(path, identity, loop), calls, seed), how)


def _of_schedules(runner: Runner, calls: Calls, seed: int) -> Task:
    """What searches are given, but for the budget.

    Without constants of a pruner nobody spends time on plans that depend on the observation.
    """
    return replace(Task.of(runner, calls, 0, seed), pruner={})
