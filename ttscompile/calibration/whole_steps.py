"""Schedules of whole steps, each with a correction of its own, and how good they are on calls it was not fitted on."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from torch import Tensor

from ..core.correction import Correction
from ..core.lattice import BoolArray, PlanArray, Source, whole_steps_plan
from ..pool import Here, Pool, Work, workers
from .calls import Actions, Calls, IntArray, calls_of
from .clock import Clock
from .runner import Runner
from .sparse_loop import Place, SparseLoop, anchors_of, fit_correction
from .targets import runner_arguments, runner_elsewhere

FITTED, COMPARED = 384, 128
"""Calls on which a candidate's correction is fitted, and others on which its error is measured; fewer if there are
fewer."""

FITTED_SHARE, SMALL_SHARE = 8, 4
"""One call in so many is fitted on where that is more, and a third as many are measured on: on Meta-World a correction
that reads the observation is no better on 384 calls, and a third better on all 12,000. The second is that of a small
network: there a longer search on the fewest calls ended with a worse schedule (``docs/decisions.md``)."""

QUARTERS = 4
"""Of the episodes: one is compared on, and the others are fitted on."""

TELLING, WORTH = 4, 0.05
"""Episodes from which on half of them say something, and what they have to bring for more to be worth recording."""

MakePlans = Callable[[Calls], PlanArray]
"""Makes plans ``[N, K, blocks]`` of N calls."""


@dataclass(frozen=True)
class Errors:
    """Mean absolute error of the executed actions of a schedule."""

    normalised: float
    units: float


class WholeSteps:
    """Compares schedules of whole steps.

    Args:
        calls: with what the dense policy answers to them.
        seed: decides which of the calls corrections are fitted on, and which, of other episodes, schedules are compared
            on.
        pool: where candidates are compared; None for this process.
        small: whether the network is so small that it answered more calls than usual. Then candidates take more of
            them, and all quarters of the episodes say whether corrections read the observation.
    """

    _pace = 0.0
    """Seconds that a comparison took, for each step that its schedule computes; the most so far."""

    def __init__(self, runner: Runner, calls: Calls, seed: int, pool: Pool | None = None, small: bool = False) -> None:
        self._runner, self._actions, self._calls = runner, Actions(runner.view.manifest.spec), calls
        self._reading: dict[int, bool] = {}
        self._known: dict[tuple[int, ...], Errors] = {}
        self._runs: dict[bool | None, ScheduleRuns] = {}
        self._pool = pool or Here()
        alone = replace(calls, late=None)
        self._work = Work(self.measured, _measured_elsewhere, (*runner_arguments(runner), alone, seed, small))
        self._seed, self._small = seed, small
        self._fitted, self._compared = self._divided(0, SMALL_SHARE if small else FITTED_SHARE)

    def _divided(self, part: int, share: int) -> tuple[Calls, Calls]:
        """Calls that corrections are fitted on, and those of a part of the episodes, that they are compared on."""
        calls = self._calls
        order = np.random.default_rng((self._seed, 3, 0)).permutation(calls.count // calls.window)
        apart = _set_apart(calls.episodes[:: calls.window][order], part)

        def some(windows: IntArray, most: int) -> Calls:
            return self._runner.select(calls, calls_of(windows[: max(1, most // calls.window)], calls.window))

        fitted, compared = _sizes(calls.count, share)
        others = some(order[apart], compared)
        return others if apart.all() else some(order[~apart], fitted), others

    @property
    def steps(self) -> int:
        """K."""
        return self._runner.model.steps

    def plan(self, steps: Sequence[int]) -> PlanArray:
        """The schedule that computes these steps and reads TIMESTEP elsewhere, int8 ``[K, blocks]``."""
        return whole_steps_plan(self.steps, self._runner.model.blocks, steps)

    def errors(self, steps: Sequence[int]) -> Errors:
        """Errors of a schedule, with a correction of its own, on calls that this was not fitted on.

        Or without one where that is better: fitted on too few calls, a correction does harm.
        """
        self.expect([tuple(steps)])
        return self._known[tuple(steps)]

    def expect(self, schedules: Iterable[tuple[int, ...]]) -> None:
        """Compare the first of these schedules now, and those after it that the pool has room for; unless it is known.

        ``errors`` then knows them. What is not asked for after all was computed in vain, and changes nothing.
        """
        coming = list(islice(schedules, self._pool.count))
        if not coming or coming[0] in self._known:
            return
        coming = [steps for steps in dict.fromkeys(coming) if steps not in self._known]
        for steps, (errors, pace) in zip(coming, self._pool.map(self._work, coming), strict=True):
            self._known[steps], self._pace = errors, max(self._pace, pace)

    def measured(self, steps: Sequence[int]) -> tuple[Errors, float]:
        """The errors of a schedule, and ``_pace``: what is done for a candidate, wherever that is."""
        reads = self.reads(len(steps))
        clock = Clock()
        errors = min((self._error_with(steps, one) for one in (reads, None)), key=lambda found: found.normalised)
        self._pace = max(self._pace, clock.elapsed() / len(steps))
        return errors, self._pace

    def correction_of(self, plan: PlanArray | MakePlans) -> Correction | None:
        """Of a plan ``[K, blocks]``, or of what makes plans of calls, fitted on all calls; None if better without."""
        plans = _plans(plan, self._calls)
        reads = self.reads(max(1, int(anchors_of(plans).sum())))  # of whole steps, those that are computed
        fitted = fit_correction(self._runner, _plans(plan, self._fitted), self._fitted, reads)
        tried = (
            self._runner.corrected(one).run(_plans(plan, self._compared), self._compared) for one in (fitted, None)
        )
        corrected, plain = (self._errors_of(samples, self._compared) for samples in tried)
        if plain.normalised <= corrected.normalised:
            return None
        return fit_correction(self._runner, plans, self._calls, reads)

    def reads(self, count: int) -> bool:
        """Whether corrections of schedules of so many steps read the observation.

        They do if that is better on episodes that they were not fitted on. Decided once, on two schedules whose steps
        halve what is left of the loop: the first and the last of 0, 50, 75, 88, 94, 97 of 100. Corrections that read
        the observation are best with late steps, and others with early ones. A small network is asked on every quarter
        of the episodes, since one may say the opposite of the others.
        """
        if count not in self._reading:
            halving = [self.steps - (self.steps >> i) for i in range(1, 6) if self.steps >> i > 1]
            more = max(0, min(count - 1, len(halving)))
            tried = [(0, *some) for some in (halving[:more], halving[len(halving) - more :])]
            best = {
                reads: min(self._error_with(steps, reads).normalised for steps in tried) + self._on_others(tried, reads)
                for reads in (True, False)
                if len(np.unique(self._fitted.episodes)) > 1
            }
            self._reading[count] = bool(best) and best[True] < best[False]
        return self._reading[count]

    def _on_others(self, tried: Sequence[Sequence[int]], reads: bool) -> float:
        """The least errors of these schedules on the other quarters of the episodes, summed; 0 if none is asked."""
        total, parts = 0.0, min(QUARTERS, len(np.unique(self._calls.episodes)))
        for part in range(1, parts if self._small else 1):
            fitted, compared = self._divided(part, FITTED_SHARE)
            loop = SparseLoop(self._runner, fitted, compared, reads=reads, whole=True)
            runs = ScheduleRuns(loop, self.steps, self._runner.model.blocks)
            total += min(self._errors_of(runs.end(steps).samples, compared).normalised for steps in tried)
        return total

    def _error_with(self, steps: Sequence[int], reads: bool | None) -> Errors:
        """Errors of a schedule with a correction that may, or may not, read the observation; None: without one."""
        if reads not in self._runs:
            fitted = None if reads is None else self._fitted
            loop = SparseLoop(self._runner, fitted, self._compared, reads=bool(reads), whole=True)
            self._runs[reads] = ScheduleRuns(loop, self.steps, self._runner.model.blocks)
        return self._errors_of(self._runs[reads].end(steps).samples, self._compared)

    def told_of_episodes(self, steps: Sequence[int]) -> str:
        """Whether more recorded episodes may pay for a schedule: a clause; empty where too few say nothing.

        By how much nearer its correction brings it, on other episodes, with as many calls of all as of half of them:
        twice as many bring the same share again where errors fall as a power of their number.
        """
        episodes, of = np.unique(self._fitted.episodes), self._calls.episodes
        if len(episodes) < TELLING or self._calls.window > 1:
            return ""
        half, every = (np.flatnonzero(np.isin(of, some)) for some in (episodes[::2], episodes))
        count, reads = min(len(half), self._fitted.count), self.reads(len(steps))
        parts = (self._runner.select(self._calls, some[:count]) for some in (half, every))
        loops = (SparseLoop(self._runner, part, self._compared, reads=reads, whole=True) for part in parts)
        before, now = (self._errors_of(one.end(self.plan(steps)).samples, self._compared).normalised for one in loops)
        gain = max(before - now, 0.0) / max(before, 1e-30)  # 0 where nothing is left
        told = f"learned from {len(episodes)} it is {gain:.0%} nearer than learned from half of them"
        if gain < WORTH:
            return f"more episodes would hardly pay: {told}"
        return f"more episodes may pay: {told}, and {len(episodes)} more to learn from may bring as much again"

    def comparing(self, full_steps: int) -> float:
        """Seconds that ``errors`` of a schedule takes, by those so far; 0 before any."""
        return self._pace * full_steps

    def correcting(self, full_steps: int) -> float:
        """Seconds that ``correction_of`` a schedule takes, by the comparisons so far; 0 before any."""
        late = 0 if self._calls.late is None else self._calls.late.count
        share = (self._calls.count + late) / (self._fitted.count + 2 * self._compared.count)
        return (1 + 2 * share) * self.comparing(full_steps)  # without jumps, and with them

    def _errors_of(self, samples: Tensor, of: Calls) -> Errors:
        normalised, units = (float(self._actions.errors(samples, of.targets, units=u).mean()) for u in (False, True))
        return Errors(normalised, units)


def _measured_elsewhere(
    path: str, identity: str, loop: str, calls: Calls, seed: int, small: bool
) -> Callable[[Sequence[int]], tuple[Errors, float]]:
    runner = runner_elsewhere(path, identity, loop)
    return WholeSteps(runner, calls, seed, small=small).measured


def _plans(plan: PlanArray | MakePlans, calls: Calls) -> PlanArray:
    return plan(calls) if callable(plan) else plan


def _sizes(count: int, share: int) -> tuple[int, int]:
    """Of so many calls, how many candidates are fitted on and measured on, at most."""
    return max(FITTED, count // share), max(COMPARED, count // (3 * share))


def _set_apart(episodes: IntArray, part: int = 0) -> BoolArray:
    """Which calls, of the episodes ``[n]``, are compared on: all of a quarter of the episodes, the first ones for 0.

    A correction reads the observation, and those of one episode are nearly the same. If there is one episode alone, a
    quarter of its calls.
    """
    known = episodes[np.sort(np.unique(episodes, return_index=True)[1])]
    if len(known) > 1:
        size = max(1, len(known) // QUARTERS)
        return np.isin(episodes, known[part * size : (part + 1) * size])
    return np.arange(len(episodes)) < len(episodes) // QUARTERS if len(episodes) > 1 else np.ones(1, np.bool_)


BYTES = 2**29
"""What kept places may hold of samples and residuals; those that were longest of no use go first."""


class ScheduleRuns:
    """Takes schedules through a sparse loop. What several of them have in common is computed once.

    Two schedules make the same samples and get the same corrections up to the first step in which they differ, so the
    places where they may part are kept. Then all placements of three steps among 16 take a third of the evaluations.
    """

    def __init__(self, loop: SparseLoop, steps: int, blocks: int, most_bytes: int = BYTES) -> None:
        self._loop, self._steps, self._most_bytes = loop, steps, most_bytes
        self._computed: PlanArray = np.full((1, blocks), Source.COMPUTE, np.int8)
        self._idle: PlanArray = np.full((1, blocks), Source.TIMESTEP, np.int8)
        self._kept: dict[tuple[int, ...], list[Place]] = {}

    def end(self, steps: Sequence[int]) -> Place:
        """The place after the last step of the schedule that computes these, the first of which is 0."""
        *before, last = steps
        with workers() as pool:
            for count in range(1, len(before) + 1):
                self._keep_places(tuple(before[:count]), steps[count], pool)
            place = self._loop.after(self._parting(tuple(before), last), self._computed, pool)
            while place.step < self._steps:
                place = self._loop.after(place, self._idle, pool)
        self._forget()
        return place

    def _parting(self, before: tuple[int, ...], step: int) -> Place:
        """Where a schedule is before a step, after having computed some."""
        return self._kept[before][step - before[-1] - 1] if before else self._loop.begin

    def _keep_places(self, steps: tuple[int, ...], to: int, pool: ThreadPoolExecutor) -> None:
        """Compute the last of these steps, and no other one up to a later step; keep all places from there to that."""
        places = self._kept.pop(steps, [])
        self._kept[steps] = places  # the last of them is the one that was of use last
        if not places:
            places.append(self._loop.after(self._parting(steps[:-1], steps[-1]), self._computed, pool))
        while places[-1].step < to:
            places.append(self._loop.after(places[-1], self._idle, pool))

    def _forget(self) -> None:
        held = {
            steps: sum({id(one): one.nbytes for place in places for one in place.held}.values())
            for steps, places in self._kept.items()
        }
        for steps in list(held):
            if sum(held.values()) <= self._most_bytes:
                return
            del held[steps], self._kept[steps]
