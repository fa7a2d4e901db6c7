"""Which loop, and how many of its steps: of each loop the fewest computed steps that are near enough to the original.

In each loop crowded schedules of more and more whole steps are proposed first, with corrections, until one is near
enough to be the default (``proposer.near``), and one more, for what is learned after it to trade. They take seconds, so
there is a default even where time is short. Then schedules are searched in the same way, from the fewest steps on.

Another loop than the original's is somewhere else even where it computes every step, and its plans hardly come nearer
than that. So loops that are near enough themselves are tried first, from the one on whose cheapest call this machine
spends least, and the original's own after them. Where the best plan by then uses more than half of the bound, the
original's loop is searched for one that is a good deal nearer, however long a call of it takes: for tasks that forgive
less than the bound does. Loops that are further come last. They may only give ``fast``, and get less of the time. One
that is too far even for that is left out, and so is one whose cheapest call takes longer than the best plan so far.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ...core.lattice import dense_plan, uniform_plan
from ...core.plan import ORIGINAL, Plan
from ...errors import CalibrationFailedError
from ...measure.points import TENTH
from ...measure.units import rounded_up
from ..arguments import MOST_CALLS, MOST_NEEDED, CallLimits, calls_to_learn_from
from ..clock import Clock
from ..judge import TIMED, Score, judge, other_noise, other_observations, seconds_to_judge, timed
from ..proposer import SAFER, SURE, Proposal, Proposals, Proposer, Request, near
from ..schedule import intervals_of, resumed_search
from ..step_counts import COUNTS, FEWER_CROWDINGS, SpacedSchedules, spaced_steps
from ..task import Found, Task
from ..trials import Trials
from ..tts import Tts

HOPELESS = 5.0
"""A number of steps is not searched any further if the error of its crowded schedules, as a share of what other noise
changes, is so many times what a distance may be. A search halves that error, and a distance grows less than it."""

REACH = 4.0
"""A number of steps is not searched with all calls of a small network, which takes minutes, if its crowded schedule is
so many times further than a distance may be. Searched, 12 of Meta-World's 100 steps are just beyond a tenth, and three
are 0.38 away."""

CLEARLY = 1.2
"""Nothing is left out as slower that takes less than so many times as long: costs are medians of a few calls on a
machine that does other work too. In the end all plans are timed in turn."""

ANSWERING = 0.4
"""Share of a loop's time for the answers to learn from."""

ASIDE = 0.25
"""Weight, where time is divided, of a loop that may only give ``fast``; that of others is 1."""


class Cost(NamedTuple):
    """What calls of a loop take, in milliseconds: with ``one`` computed step, and more for each further ``step``."""

    one: float
    step: float

    def of(self, steps: int) -> float:
        """With so many computed steps."""
        return self.one + (steps - 1) * self.step


class Loops(Proposer):
    """See the module, and ``Proposer``."""

    def __init__(self, request: Request) -> None:
        super().__init__(request)
        self._bound, self._farthest = request.bound, request.farthest
        self._left_out: list[str] = []
        self._scores: dict[str, Score] = {}
        self._tasks: dict[str, Task] = {}
        self._best: Proposal | None = None
        self._fastest = float("inf")  # ms of the best one, by its ``Cost``
        self._nearest: Proposal | None = None  # of those within ``farthest``, where none is within the bound

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """See ``Proposer``. Of a policy of one step all cells, for what is learned after it."""
        if max(loop.steps for loop in trials.artifact.manifest.spec.all_loops.values()) == 1:
            self.told = "one evaluation gives the actions: there is nothing to reuse between steps"
            yield Proposal(_name(ORIGINAL, 1), replace(plan, precision={}, repair=True), margin=float("inf"))
            return
        costs = {loop: self._cost(trials, loop, clock) for loop in trials.artifact.manifest.spec.all_loops}
        close, far = self._by_distance(trials, costs)
        order = [*close, ORIGINAL, *far]
        for number, loop in enumerate(order):
            wanted = self._farthest if loop in far else self._wanted(loop)
            if wanted >= self._bound and (reason := self._too_slow(costs[loop].one, self._fastest)) is not None:
                self._left_out.append(f"{loop} {reason}")
                continue
            if number and _over(clock, trials, _crowds(loop), loop):
                self._left_out.append(f"{loop} for want of time")
                continue
            weights = [ASIDE if one in far else 1.0 for one in order[number:]]
            share = clock.left() * weights[0] / sum(weights)
            own = self._opened(trials, loop, share)
            yield from self._of_loop(own, loop, _ending(clock, share), costs[loop], wanted)
        best = self._best or self._nearest
        found = "computes the least of those that are near enough" if self._best else "is the nearest"
        if best is None:
            told = self._none(trials, min(order, key=lambda loop: costs[loop].one), costs)
            if self.request.deadline_ms is not None or not clock.left_out:
                raise CalibrationFailedError(told)
            trials.bar.warn(f"{told} Time was too short, so the original is all that there is.")
            return
        yield best
        left = f"left out: {', '.join(self._left_out)}" if self._left_out else ""
        whole, steps = self._tasks[best.name].whole, best.notes["steps"]
        # Each of its two answers takes about what a comparison takes without a correction and with one.
        there_is_time = clock.has(2 * whole.comparing(len(steps)), "what more episodes would bring")
        more = whole.told_of_episodes(steps) if there_is_time else ""
        self.told = "; ".join(filter(None, (f"{best.name} {found}", left, more)))

    def _by_distance(self, trials: Trials, costs: Mapping[str, Cost]) -> tuple[list[str], list[str]]:
        """Other loops than the original's that may give the default, and those that may give ``fast``; cheapest first.

        By how far they are with every step computed.
        """
        close, far = list[str](), list[str]()
        for loop in sorted(costs.keys() - {ORIGINAL}, key=lambda loop: costs[loop].one):
            own = trials.of_loop(loop)
            plan = Plan(loop, dense_plan(own.runner.model.steps, own.runner.model.blocks), repair=True)
            if _over(trials.clock, trials, _crowds(loop), loop, seconds_to_judge(own, plan)):
                self._left_out.append(f"{loop} for want of time")
                continue
            whole = judge(own, plan)
            if whole.interval[0] > self._farthest:
                self._left_out.append(f"{loop} is {whole.distance:.3g} from the original with every step computed")
            else:
                (close if whole.distance <= self._bound else far).append(loop)
        return close, far

    def _wanted(self, loop: str) -> float:
        """How near a plan of a loop has to be for the search to end there."""
        if loop != ORIGINAL or self._best is None or self.request.deadline_ms is not None:
            return self._bound
        found = self._scores[self._best.name].distance
        return SAFER * found if found > self._bound / 2 else self._bound

    def _of_loop(self, own: Trials, loop: str, clock: Clock, cost: Cost, wanted: float) -> Proposals:
        """Plans of more and more computed steps of a loop until one is as near as is wanted: crowded, then searched."""
        calls, few = own.calls, max(own.limits.usual, MOST_NEEDED)
        small = calls.count > few
        # Each number of steps is fitted to all: with thousands the time would end before the steps are enough.
        late = calls.late and own.runner.select(calls.late, range(min(few, calls.late.count)))
        first = replace(own.runner.select(calls, range(few)), late=late) if small else calls
        task = replace(Task.of(own.runner, first, 0, own.seed, own.pool), clock=clock)
        counts = yield from self._crowded(own, task, loop, cost, wanted)
        names = [_search(loop, count) for count in counts]
        if small and not all(_over(clock, own, intervals_of(name), name) for name in names):
            task = replace(Task.of(own.runner, calls, 0, own.seed, own.pool, small=small), clock=clock)
            counts = self._within_reach(loop, counts, wanted)
        reached = False  # what is wanted; then one number of steps more is tried
        for number, count in enumerate(counts):
            name = _search(loop, count)
            if number and _over(clock, own, intervals_of(name), name):
                break
            share = _ending(clock, clock.left() / (len(counts) - number))
            search = Tts(replace(task, clock=share, budget=count * own.runner.model.blocks))
            found = resumed_search(own, search, share, None, name)[0]
            yield from self._judged(own, self._proposal(task, loop, count, found), cost.of(count))
            before, reached = reached, self._reached(loop, count, wanted)
            if before or (reached and wanted < self._bound):
                break

    def _crowded(
        self, own: Trials, task: Task, loop: str, cost: Cost, wanted: float
    ) -> Generator[Proposal, bool, list[int]]:
        """Plans that crowd their computed steps; returns the numbers of steps that a search may make near enough."""
        safer = wanted < self._bound
        fastest = float("inf") if safer else self._fastest  # of the loops before
        crowded = SpacedSchedules(task.whole, own.state, task.clock, own.bar, _crowds(loop))
        counts = [n for n in COUNTS if n <= max(1, own.runner.model.steps // 2)]
        apart = other_noise(own) or TENTH * other_observations(own)  # the judge's unit where noise changes nothing
        hopeless = HOPELESS * (wanted if safer else self._farthest) * apart
        hopeful, reached = list[int](), False
        for number, count in enumerate(counts):
            if number and self._too_slow(cost.of(count), fastest):
                break
            quick = crowded.best(count, f"{loop}, {count} steps", FEWER_CROWDINGS)
            if quick is None:  # no time; where nothing was found, even steps without a correction give something
                if not hopeful and self._best is None:
                    even = spaced_steps(own.runner.model.steps, counts[-1], 1.0)
                    found = Found(task.whole.plan(even), {"steps": list(even)})
                    yield from self._judged(own, self._proposal(task, loop, counts[-1], found), cost.of(counts[-1]))
                return hopeful
            if quick.error > hopeless and count != counts[-1]:
                continue
            hopeful.append(count)
            proposal = self._proposal(task, loop, count, task.whole_steps(quick.steps))
            yield from self._judged(own, proposal, cost.of(count))
            before, reached = reached, self._reached(loop, count, wanted)
            if before or (reached and safer):
                break
        return hopeful

    def _within_reach(self, loop: str, counts: list[int], wanted: float) -> list[int]:
        """Those of these numbers of steps that a search with more calls may bring as near as is wanted."""
        scores = ((count, self._scores.get(_name(loop, count))) for count in counts)
        return [n for n, score in scores if score is None or score.distance <= REACH * wanted] or counts[-1:]

    def _proposal(self, task: Task, loop: str, count: int, found: Found) -> Proposal:
        name, made = _name(loop, count), Plan(loop, found.schedule, found.correction, repair=True)
        self._tasks[name] = task
        return Proposal(name, made, found.notes, beside=True, refusal=partial(self._refusal, name))

    def _judged(self, own: Trials, proposal: Proposal, cost: float) -> Proposals:
        """Have a plan judged; where it is kept, it may be the best so far."""
        held = yield proposal
        if not held:
            return
        score, alone = self._scores[proposal.name], replace(proposal, beside=False, margin=float("inf"))
        again = self._best is not None and self._best.name == proposal.name  # nearer now
        if near(score.distance, score.interval, self._bound) and (again or cost < self._fastest):
            self._best, self._fastest = alone, cost
        nearest = None if self._nearest is None else self._scores[self._nearest.name].distance
        if near(score.distance, score.interval, self._farthest) and (nearest is None or score.distance <= nearest):
            self._nearest = alone
        if alone is (self._best or self._nearest):
            own.bar.best(f"{proposal.plan.in_words()}, {cost:.3g} ms, {score.distance:.2g} away")

    def _reached(self, loop: str, count: int, wanted: float) -> bool:
        """Whether a plan of so many steps is as near as is wanted; with a deadline as many are tried as keep it."""
        score = self._scores[_name(loop, count)]
        return near(score.distance, score.interval, wanted) and self.request.deadline_ms is None

    def _opened(self, trials: Trials, loop: str, seconds: float) -> Trials:
        limit, now = trials.clock.limit, trials.clock.elapsed()
        until_share = (now + ANSWERING * seconds) / limit if np.isfinite(limit) else 1.0
        own = replace(trials.of_loop(loop), begun_at=now, until_share=until_share)
        minutes = max(seconds, 1.0) / 60 if np.isfinite(seconds) else 1e3
        limits = calls_to_learn_from(own.runner.view.manifest, minutes, corrects=True)
        usual = own.state.progress.setdefault(f"most of {loop}", limits.usual)
        return replace(own, limits=CallLimits(limits.fewest, usual, max(usual, MOST_CALLS)))

    def _too_slow(self, least: float, fastest: float) -> str | None:
        """Why calls that take at least so many milliseconds cannot be what is looked for."""
        if self.request.deadline_ms is not None:
            slow = least > self.request.deadline_ms
            return f"takes {least:.3g} ms and {self.request.deadline_ms:.3g} are allowed" if slow else None
        return f"takes {least:.3g} ms at least, and the best {fastest:.3g}" if least > CLEARLY * fastest else None

    def _refusal(self, name: str, score: Score, kept: Mapping[str, Score]) -> str | None:
        """Why a plan is too far from the original for all purposes, or no nearer than another of as many steps."""
        if name in kept and kept[name].distance < score.distance:
            return f"is {score.distance:.3g} from the original; another of as many steps {kept[name].distance:.3g}"
        self._scores[name] = score
        if score.distance <= self._farthest:
            return None
        return f"is {score.distance:.3g} from the original; {self._farthest:g} is allowed"

    def _none(self, trials: Trials, least: str, costs: Mapping[str, Cost]) -> str:
        if self._scores:
            nearest = min(self._scores, key=lambda name: self._scores[name].interval[1])
            return too_far(trials, self.request, nearest, self._scores[nearest])
        deadline, takes = self.request.deadline_ms, costs[least].one
        if deadline is not None and takes > deadline:
            one = f"one computed step of {least!r}, the least that a call can have, takes {takes:.3g} ms,"
            told = f"no plan keeps {deadline:.3g} ms: {one} {takes / deadline:.3g} times as long."
            return f"{told} {would_help(trials, self.request)}"
        left = "; ".join(self._left_out) or "the time ended the search"
        return f"no plan could be tried: {left}. Allow more time."

    def _cost(self, trials: Trials, loop: str, clock: Clock) -> Cost:
        """What calls of a loop take on this machine, in the faster precision; measured once."""
        known = trials.state.progress.setdefault("costs", {})
        if loop not in known:
            trials.bar.stage(f"timing {loop}", 1)
            known[loop] = self._measured(trials, loop)
            trials.state.save(seconds=clock.elapsed())
        with trials.state.reading():
            one, step = known[loop]
            return Cost(float(one), float(step))

    def _measured(self, trials: Trials, loop: str) -> tuple[float, float]:
        manifest, record = trials.artifact.manifest, trials.artifact.manifest.precision
        steps, blocks = manifest.steps_of(loop), len(manifest.blocks)
        lowered = [] if record is None else [dict.fromkeys(record.kept, record.name)]
        counts = (1, min(4, steps))
        plans = [Plan(loop, uniform_plan(steps, blocks, n), precision=p) for p in ({}, *lowered) for n in counts]
        took = [one.median for one in timed([(trials, plan) for plan in plans], self.request.threads, TIMED // 2)]
        pairs = zip(took[::2], took[1::2], strict=True)
        return min((one, max(more - one, 0.0) / max(counts[1] - 1, 1)) for one, more in pairs)


def _name(loop: str, count: int) -> str:
    return f"{loop.replace('+', '')}.{count}"  # in the name of a plan a + is before a part


def _crowds(loop: str) -> str:
    """Where the state keeps what crowded schedules of a loop are worth."""
    return f"crowded, {loop}"


def _search(loop: str, count: int) -> str:
    """The name of a search of so many steps."""
    return f"search, {loop}, {count} steps"


def _over(clock: Clock, trials: Trials, begun: str, what: str, seconds: float = 0.0) -> bool:
    """Whether there is no time for this. What an interrupted build has begun is in the state, and read again."""
    return begun not in trials.state.progress and not clock.has(seconds, what)


def _ending(clock: Clock, seconds: float) -> Clock:
    """The same clock with so many more seconds, and no more than there are."""
    return clock.until(min(1.0, (clock.elapsed() + seconds) / clock.limit))


def too_far(trials: Trials, request: Request, name: str, score: Score) -> str:
    """What a user is told where no plan is near enough, given the nearest."""
    bound, more = request.farthest, "Record more episodes, or allow more time or a larger error."
    return (
        f"no plan is near enough to the original: the nearest, {name!r}, is {score.distance:.3g} away, and"
        f" {score.interval[1]:.3g} at worst; {bound:g} and {SURE * bound:g} are allowed."
        f" {more if request.deadline_ms is None else would_help(trials, request, also=('more time', 'more episodes'))}"
    )


def would_help(trials: Trials, request: Request, within: float | None = None, also: Sequence[str] = ()) -> str:
    """What a user is told whose deadline no plan keeps that is near enough; one that is ``within`` does, if given."""
    spec = trials.artifact.manifest.spec
    told = [*also, f"more than {request.threads} thread{'s' * (request.threads > 1)} (--threads)"]
    told += ["a camera less (--without-camera)"] * (sum(one.image for one in spec.observations.values()) > 1)
    told += ["one instruction compiled in (--task)"] * (spec.instruction is not None)
    told += ["a larger --error" if within is None else f"--error {rounded_up(within)}"]
    return f"What may help: {', '.join(told)}, or a slower loop."
