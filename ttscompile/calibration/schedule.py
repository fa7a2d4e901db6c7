"""The proposer of schedules: a search for as long as there is time, the baseline, and plans beside the target."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from ..artifact.load import Artifact
from ..artifact.view import View, view_of
from ..core.lattice import sparsity, uniform_plan
from ..core.plan import SCHEDULE, UNIFORM, Plan
from ..errors import CalibrationError
from ..ir.pieces import PRUNER
from ..ir.plan_head import has_head
from .budget import ERROR, FLOPS, LATENCY, Goal, cells_of, measure_budget
from .clock import Clock
from .judge import Score
from .proposer import Proposal, Proposals, Proposer, Request, ScheduleRow
from .step_counts import BESIDE_SHARE, SAFE, SpacedSchedules, budget_of_error, plans_beside
from .task import Found, Search, Task
from .trials import Trials, base_of


def search_plan(
    search: Search,
    clock: Clock,
    most: int | None = None,
    first: int = 0,
    after: Callable[[int, float], None] = lambda done, longest: None,
) -> tuple[Found, int, str]:
    """Intervals until the search is done, or the time is up; one at least.

    Args:
        search: after its first ``first`` intervals.
        most: intervals; None for the search's own number.
        first: the interval to begin with.
        after: told after each interval how many are done, and how many seconds the longest took.

    Returns:
        What was found, after how many intervals, and why it stopped: ``finished`` or ``time limit``.

    Raises:
        CalibrationFailedError: the time was up before there was a plan within the budget.
    """
    count = search.intervals if most is None else min(most, search.intervals)
    number, longest = first, 0.0
    while number < count and not search.done:
        start = clock.elapsed()
        if number > 0 and not clock.has(longest + search.seconds_to_finish):
            break
        search.advance(number)
        number += 1
        longest = max(longest, clock.elapsed() - start)
        after(number, longest)
    return search.found(), number, TIME_LIMIT if clock.left_out else FINISHED


def intervals_of(name: str) -> str:
    """Where the state keeps how many intervals of a search are done."""
    return f"{name} intervals"


def resumed_search(
    trials: Trials, search: Search, clock: Clock, most: int | None, name: str = "search"
) -> tuple[Found, int, str]:
    """``search_plan`` from where the state is; saved after every interval, under a name."""
    state, bar, done_so_far = trials.state, trials.bar, intervals_of(name)
    first = int(state.progress.get(done_so_far, 0))
    count = search.intervals if most is None else min(most, search.intervals)
    if first:
        with state.reading():
            search.restore(state.get(name))
    bar.stage(name, count, first)

    def save(done: int, longest: float) -> None:
        state.put(name, search.state())
        state.save(**{done_so_far: done}, seconds=clock.elapsed())
        left = min(clock.left(), (count - done) * longest)
        bar.update(done, f"error {search.loss:.4f}, sparsity {sparsity(search.plan):.2%}", left)

    return search_plan(search, clock, most, first, save)


FINISHED, TIME_LIMIT = "finished", "time limit"
"""Why a search stopped."""

NO_NUMBERS = 1e9
"""A distance above this is the mean of calls of which one is ``LARGEST`` off."""

BETTER = 0.9
"""A plan has to bring the distance below this share of the uniform schedule's."""


class Schedule(Proposer):
    """Plans of whole steps, corrected; or what the search of another row finds. See ``Proposer``.

    It tells its budget, once it is known what it comes to, why it stopped, and why there is no plan of a name.
    """

    def __init__(self, request: Request, row: ScheduleRow) -> None:
        super().__init__(request)
        self._row = row
        self.budget, self.intervals, self.stopped = request.goal, 0, ""
        self.skipped: dict[str, str] = {}

    def applies(self, artifact: Artifact) -> str | None:
        view, goal = view_of(artifact, base_of(artifact)), self.request.goal
        if view.manifest.steps == 1:
            told = "the policy has one denoising step, which every plan computes: nothing can be reused"
            return f"{told}. Learn which parts may have eight bits: --learn precision."
        if goal.kind == ERROR and not self._row.corrects:
            return (
                f"max_action_error: expected a proposer that fits corrections, {SCHEDULE!r}; found {self._row.name!r}."
                " Give this one a target_sparsity, a target_flops or a latency_ms."
            )
        if self.request.correct and self._row.corrects:
            return f"{self._row.name!r} fits a correction of its own. Leave correct out."
        try:
            if goal.kind not in (LATENCY, ERROR):
                cells = cells_of(goal, view.manifest, self._may_prune(view))
                self._row.require_reach(view.manifest.steps, len(view.manifest.blocks), cells)
        except CalibrationError as error:
            return str(error)
        return None

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        view, request = trials.runner.view, self.request
        self._manifest = view.manifest
        steps, blocks = view.manifest.steps, len(view.manifest.blocks)
        budget = self._budget(trials, view, clock)
        calls = trials.windows if self._row.consecutive else trials.calls
        small = calls.count > trials.limits.usual
        task = Task.of(trials.runner, calls, 0, trials.seed, trials.pool, small=small)
        crowded = SpacedSchedules(task.whole, trials.state, clock, trials.bar)
        if budget is None:
            budget = budget_of_error(crowded, request.goal, steps, blocks)
        share = 1 - BESIDE_SHARE if self._row.corrects else 1.0
        task = replace(task, budget=budget.cells, clock=clock.until(share))
        search = self._row.search(task)
        found, self.intervals, self.stopped = resumed_search(trials, search, task.clock, request.intervals)
        if request.correct:
            found = task.corrected(found)
        while True:
            self.budget = budget
            # The last cells of the budget are rounded up to a whole step, in the baseline's favour.
            baseline = replace(plan, cells=uniform_plan(steps, blocks, -(-budget.cells // blocks)))
            yield Proposal(UNIFORM, baseline, beside=True)
            made = replace(plan, cells=found.schedule, correction=found.correction)
            kept = yield Proposal(SCHEDULE, made, found.notes, margin=float("inf"), refusal=self._refusal)
            full = budget.cells // blocks
            more = full + max(1, full // 4)  # where the error is kept on calls to learn from, and not on held-out ones
            if kept or request.goal.kind != ERROR or more > steps // 2:
                break
            best = crowded.best(more, f"{more} steps")
            if best is None:
                break
            found, budget = task.whole_steps(best.steps), replace(budget, cells=more * blocks)
        if not kept:
            return
        self.told = f"{budget.cells} of {steps * blocks} cells may be computed; the search took {self.intervals}"
        self.told += f" interval{'s' * (self.intervals != 1)}"
        if "steps" in found.notes and (heard := task.whole.told_of_episodes(found.notes["steps"])):
            self.told += f"; {heard}"
        if found.pruner is not None:
            yield self._of_pruner(plan, found)
        named, self.skipped = plans_beside(crowded, task, self._row, budget.cells)
        self.stopped = TIME_LIMIT if clock.left_out else self.stopped
        for name, one in named.items():
            made = replace(plan, cells=one.schedule, correction=one.correction)
            proposal = Proposal(name, made, {"steps": one.notes["steps"]}, beside=True)
            yield replace(proposal, refusal=_no_safer) if name == SAFE else proposal

    def _budget(self, trials: Trials, view: View, clock: Clock) -> Goal | None:
        """The budget; None where it is found on the calls to learn from."""
        goal, manifest = self.request.goal, view.manifest
        if goal.kind == ERROR:
            return None
        if goal.kind != LATENCY:
            return replace(goal, cells=cells_of(goal, manifest, self._may_prune(view)))
        known = trials.state.progress.get("latency")
        if known is None:
            budget = measure_budget(trials, goal, self._may_prune(view))
            known = {"cells": budget.cells, "measured": budget.measured}
            trials.state.save(latency=known, seconds=clock.elapsed())
        budget = replace(goal, cells=known["cells"], measured=known["measured"])
        self._row.require_reach(manifest.steps, len(manifest.blocks), budget.cells)
        return budget

    def _may_prune(self, view: View) -> bool:
        """Whether plans may be made by the pruner, whose cost then counts."""
        return self._row.uses_pruner and has_head(view.pruner)

    def _of_pruner(self, plan: Plan, found: Found) -> Proposal:
        """The plans that the pruner makes, if they are nearer than the schedule."""
        made = replace(plan, cells=None, correction=found.pruner_correction)

        def refusal(score: Score, others: Mapping[str, Score]) -> str | None:
            return learned_nothing(score, self.intervals) or self._refusal(score, others)

        return Proposal(PRUNER, made, found.notes, pruner=found.pruner, refusal=refusal)

    def _refusal(self, score: Score, others: Mapping[str, Score]) -> str | None:
        """Which of the budget's promises a score breaks."""
        goal, uniform, manifest = self.request.goal, others[UNIFORM], self._manifest
        wished = self.budget.sparsity(manifest)
        if not score.distance <= NO_NUMBERS:
            return "gives actions that are not numbers."
        if score.sparsity < wished - 1e-9:
            return (
                f"reaches a sparsity of {score.sparsity:.4f} on held-out calls; the target is {wished:g}. Calibrate"
                " with more episodes or more time."
            )
        if goal.kind == FLOPS and score.flops_saved < goal.value - 1e-9:
            return (
                f"saves {score.flops_saved:.4f} of the FLOPs of a dense call; the target is {goal.value:g}: its blocks"
                f" cost more than the average. Raise the target a little, or learn {SCHEDULE!r}, which computes whole"
                " steps."
            )
        if goal.kind == ERROR and score.error is not None and not score.error <= goal.value:
            return (
                f"computes {self.budget.cells} cells, and is {score.error:.4g} off on average on held-out calls; at"
                f" most {goal.value:g} was asked for. Allow a larger error, more time, or calibrate with more episodes."
            )
        if not (self._row.baseline or score.distance < BETTER * uniform.distance):
            return (
                f"is no better than the uniform schedule: on held-out calls its distance from the original is"
                f" {score.distance:.4g}, the uniform schedule's {uniform.distance:.4g} (expected below {BETTER:.0%} of"
                " that). Calibrate with more episodes or more time, or lower the target."
            )
        return None


def learned_nothing(score: Score, intervals: int) -> str | None:
    """Why a head is left out that makes the same plan for every observation: it has learned nothing."""
    if score.plans > 1:
        return None
    counted = f"{intervals} update{'s' * (intervals != 1)}"
    return f"has learned nothing in {counted}: it makes one and the same plan for all held-out calls."


def _no_safer(score: Score, others: Mapping[str, Score]) -> str | None:
    if score.distance < others[SCHEDULE].distance:
        return None
    return f"is {score.distance:.4g} from the original, no safer than {SCHEDULE}: its search was cut short"
