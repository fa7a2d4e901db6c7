"""Which loop, and how many of its steps: of each loop the fewest computed steps that are near enough to the original.

Loops are tried from the one on whose cheapest call this machine spends least. In each, schedules of more and more whole
steps are proposed, with corrections, until one is near enough (``proposer.near``). One more follows, for what is
learned after it to trade. A loop is left out that is too far from the original when all is computed, and one whose
cheapest call takes longer than the best plan so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...artifact.load import Artifact
from ...core.lattice import dense_plan, uniform_plan
from ...core.plan import ORIGINAL, Plan
from ...core.spec import Noise
from ...errors import CalibrationFailedError
from ...runtimes.open import open_runtime
from ...runtimes.random_calls import Observation
from ...runtimes.runtime import Runtime
from ..arguments import calls_to_learn_from
from ..budget import median_ms
from ..clock import Clock
from ..judge import Score, judge, other_noise
from ..proposer import SURE, Proposal, Proposals, Request, near
from ..schedule import searched
from ..search import open_search
from ..step_counts import COUNTS, TRIED, SpacedSchedules
from ..task import Found, Task
from ..trials import Trials

HOPELESS = 2.5
"""A number of steps is not searched any further if its crowded schedules are so many times as far off as may be."""

CLEARLY = 1.2
"""Nothing is left out as slower that takes less than so many times as long: costs are medians of a few calls on a
machine that does other work too. In the end all plans are timed in turn."""

ANSWERING = 0.4
"""Share of a loop's time for the answers to learn from."""


@dataclass(frozen=True)
class Cost:
    """What calls of a loop take, in milliseconds.

    Attributes:
        one: with one computed step.
        step: more for each further one.
    """

    one: float
    step: float

    def of(self, steps: int) -> float:
        """With so many computed steps."""
        return self.one + (steps - 1) * self.step


class Loops:
    """See the module, and ``Proposer``."""

    def __init__(self, request: Request) -> None:
        self._request, self._bound = request, request.bound
        self.told = ""
        self._left_out: list[str] = []
        self._nearest: tuple[str, Score] | None = None
        self._near = False

    def applies(self, artifact: Artifact) -> str | None:
        """See ``Proposer``."""
        if max(artifact.manifest.steps_of(loop) for loop in _loops(artifact)) > 1:
            return None
        return "no loop of the policy has a second step: nothing can be reused"

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """See ``Proposer``."""
        artifact, fastest = trials.artifact, float("inf")
        best: Proposal | None = None
        costs = {loop: self._cost(trials, loop, clock) for loop in _loops(artifact)}
        order = sorted(costs, key=lambda loop: costs[loop].one)
        for number, loop in enumerate(order):
            cost = costs[loop]
            if (reason := self._too_slow(cost, fastest)) is not None:
                self._left_out.append(f"{loop} {reason}")
                continue
            if number and clock.left() <= 0:
                clock.cut = True
                self._left_out.append(f"{loop} for want of time")
                continue
            share = clock.left() / (len(order) - number)
            own = self._opened(trials, loop, share)
            if loop != ORIGINAL and (reason := self._too_far(_full(own, loop), own)) is not None:
                self._left_out.append(f"{loop} {reason} with every step computed")
                continue
            self._near = False
            ends = clock.until(min(1.0, (clock.elapsed() + share) / clock.limit))
            for name, one, notes, count in self._of_loop(own, loop, ends, cost, fastest):
                found: list[Score] = []
                proposal = Proposal(name, one, notes, beside=True, refusal=self._refusal(name, found))
                yield proposal
                self._near = near(found[0], self._bound)
                if self._near and cost.of(count) < fastest:
                    best, fastest = replace(proposal, beside=False, margin=float("inf")), cost.of(count)
        if best is None:
            raise CalibrationFailedError(self._none())
        yield best
        left = f"; left out: {', '.join(self._left_out)}" if self._left_out else ""
        self.told = f"{best.name} is the fastest that is near enough{left}"

    def _of_loop(
        self, own: Trials, loop: str, clock: Clock, cost: Cost, fastest: float
    ) -> Iterator[tuple[str, Plan, Mapping[str, object], int]]:
        """Plans of more and more computed steps of a loop, until one is near enough, and one more."""
        model, further = own.executor.model, False
        task = replace(Task.of(own.executor, own.calls, 0, own.seed, own.pool), clock=clock)
        crowded = SpacedSchedules(task.whole, own.state, clock, own.bar, f"crowded, {loop}")
        apart = other_noise(own)
        counts = [n for n in COUNTS if n <= max(1, model.steps // 2)]
        for number, count in enumerate(counts):
            if number and (clock.left() <= 0 or self._too_slow(replace(cost, one=cost.of(count)), fastest)):
                break
            quick = crowded.best(count, f"{loop}, {count} steps", TRIED)
            if quick is None and number:
                clock.cut = True
                break
            if quick is not None and quick.error > HOPELESS * self._bound * apart and count != counts[-1]:
                continue
            yield (*self._searched(own, task, loop, count), count)
            if further:
                break
            further = self._near and self._deadline is None  # with a deadline as many as keep it

    def _searched(self, own: Trials, task: Task, loop: str, count: int) -> tuple[str, Plan, Mapping[str, object]]:
        """The best schedule of so many steps that there is time for."""
        search = open_search("tts", replace(task, budget=count * own.executor.model.blocks))
        found: Found = searched(own, search, task.clock, None, f"search, {loop}, {count} steps")[0]
        made = Plan(loop, found.schedule, found.correction, repair=True)
        return f"{loop.replace('+', '')}.{count}", made, found.notes

    def _opened(self, trials: Trials, loop: str, seconds: float) -> Trials:
        """Trials of a loop, that has so many seconds."""
        limit, now = trials.clock.limit, trials.clock.elapsed()
        until = (now + ANSWERING * seconds) / limit if np.isfinite(limit) else 1.0
        own = replace(trials.of_loop(loop), until=until)
        minutes = max(seconds, 1.0) / 60 if np.isfinite(seconds) else 1e3
        fewest, most = calls_to_learn_from(own.executor.view.manifest, minutes, corrects=True)
        return replace(own, limits=(fewest, own.state.progress.setdefault(f"most of {loop}", most)))

    @property
    def _deadline(self) -> float | None:
        return self._request.deadline_ms

    def _too_slow(self, cost: Cost, fastest: float) -> str | None:
        """Why calls that take at least so long cannot be what is looked for."""
        if self._deadline is not None:
            most = self._deadline
            return f"takes {cost.one:.3g} ms and {most:.3g} are allowed" if cost.one > most else None
        slower = cost.one > CLEARLY * fastest
        return f"takes {cost.one:.3g} ms at least, and the best {fastest:.3g}" if slower else None

    def _too_far(self, plan: Plan, own: Trials) -> str | None:
        """Why no plan of a loop can be near enough."""
        score = judge(own, plan)
        if score.interval[0] <= self._bound:
            return None
        return f"is {score.distance:.3g} from the original"

    def _refusal(self, name: str, found: list[Score]) -> Callable[[Score, Mapping[str, Score]], str | None]:
        """Says why a plan is too far from the original for all purposes; keeps its score."""

        def refusal(score: Score, _: Mapping[str, Score]) -> str | None:
            found.append(score)
            if self._nearest is None or score.interval[1] < self._nearest[1].interval[1]:
                self._nearest = name, score
            if score.distance <= self._bound:
                return None
            return f"is {score.distance:.3g} from the original; {self._bound:g} is allowed"

        return refusal

    def _none(self) -> str:
        """Why there is nothing to propose."""
        if self._nearest is None:
            left = "; ".join(self._left_out) or "the time ended the search"
            return f"no plan could be tried: {left}. Allow more time."
        name, score = self._nearest
        return too_far(name, score, self._bound)

    def _cost(self, trials: Trials, loop: str, clock: Clock) -> Cost:
        """What calls of a loop take on this machine, in the faster precision; measured once."""
        known = trials.state.progress.setdefault("costs", {})
        if loop not in known:
            trials.bar.stage(f"timing {loop}", 1)
            known[loop] = self._measured(trials, loop)
            trials.state.progress["seconds"] = clock.elapsed()
            trials.state.save()
        with trials.state.reading():
            one, step = known[loop]
            return Cost(float(one), float(step))

    def _measured(self, trials: Trials, loop: str) -> tuple[float, float]:
        artifact, record = trials.artifact, trials.artifact.manifest.precision
        steps, blocks = artifact.manifest.steps_of(loop), len(artifact.manifest.blocks)
        obs, more = trials.observation([(trials.split.calibration[0], 0)]), min(4, steps)
        found = []
        for precision in ({}, *([dict.fromkeys(record.kept, record.name)] if record is not None else [])):
            plans = [Plan(loop, uniform_plan(steps, blocks, n), precision=precision) for n in (1, more)]
            runtime = open_runtime(artifact, "onnxruntime", self._request.threads, None, plans[0])
            noise = trials.noise(trials.view(plans[0]).manifest.spec, [(0, 0, 0, 0)])
            one, most = (median_ms(partial(_call, runtime, obs, noise, plan)) for plan in plans)
            found.append((one, max(most - one, 0.0) / max(more - 1, 1)))
        return min(found)


def too_far(name: str, score: Score, bound: float) -> str:
    """What a user is told where no plan is near enough, given the nearest."""
    return (
        f"no plan is near enough to the original: the nearest, {name!r}, is {score.distance:.3g} away, and"
        f" {score.interval[1]:.3g} at worst; {bound:g} and {SURE * bound:g} are allowed. Record more episodes, or allow"
        " more time or a larger error."
    )


def _call(runtime: Runtime, obs: Observation, noise: Noise, plan: Plan) -> None:
    """A call that computes all of its frames."""
    runtime.reset()
    runtime.predict(obs, noise, plan)


def _loops(artifact: Artifact) -> tuple[str, ...]:
    """That begin with noise."""
    return (ORIGINAL, *artifact.manifest.spec.loops)


def _full(own: Trials, loop: str) -> Plan:
    model = own.executor.model
    return Plan(loop, dense_plan(model.steps, model.blocks), repair=True)
