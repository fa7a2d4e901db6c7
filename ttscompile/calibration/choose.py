"""Which of the plans that were kept is the default: all of them judged and timed, in one run."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..artifact.corrections import correction_arrays
from ..artifact.load import Artifact
from ..artifact.onnx_files import weight_bytes
from ..artifact.view import view_of
from ..core.plan import DENSE, FULL, SCHEDULE, Plan
from ..errors import CalibrationFailedError
from ..ir.pieces import LAYERS, is_of_loop
from ..measure.points import ALIKE, best_plan, fastest
from ..measure.units import ms
from .judge import TIMED, WARM_UP, Score, call_seconds, judge, seconds_to_judge, timed
from .kept import Kept
from .proposer import SAFER, Request, least_bound
from .proposers.loops import too_far, would_help
from .step_counts import FAST, SAFE
from .trials import CONFIRMING, LEARNED

TIMED_LONG = 200
"""Calls of a plan that may be the default by a deadline: their 99th percentile has to keep it."""

SMALL = 0.05
"""Share of the artifact's files that a spare plan takes at most: one of Push-T's takes 1.6 %, and one of a network that
is small beside its corrections may take a tenth."""

CHOSEN = 3
"""Plans that get a name, and are confirmed: the default, ``safe`` and ``fast``."""


@dataclass(frozen=True)
class Frontier:
    """What was tried, and what was chosen.

    Attributes:
        tried: all plans, fastest first, the original and those too far away among them; JSON. ``name`` is that in the
            artifact, or what it was called while it was tried; ``told`` what it does, in words; ``distance`` and
            ``interval`` how far it is from the original on held-out episodes, with 95 % limits (``judge``), ``within``
            the least bound that allows that, and ``confirmed`` the first two on other calls of these episodes, for what
            was chosen; ``milliseconds`` and ``worst`` the median and ``Times.worst`` of its ``calls`` here, in
            milliseconds; ``weights`` the bytes of those that its models read; ``near`` whether it is within
            ``Request.farthest``; ``kept`` whether the artifact gets it, and ``spare`` whether it does so for other
            machines.
        plans: that the artifact gets, by name.
        spare: that it gets for other machines, by the names that they had while they were tried.
        default: ``schedule``, or ``dense`` where no plan may be the default unasked.
    """

    tried: tuple[dict[str, Any], ...]
    plans: dict[str, Plan]
    spare: dict[str, Plan]
    scores: dict[str, Score]
    default: str


def seconds_to_judge_others(kept: Kept, lowers: bool) -> float:
    """That judging takes what has not been judged so; ``lowers``: in another precision, whose parts are tried first."""
    trials, record = kept.trials, kept.trials.artifact.manifest.precision
    plans = {name: plan for name, plan in kept.plans.items() if name not in (DENSE, FULL)}
    new = [plan for name, plan in plans.items() if lowers or kept.known(name, plan) is None]
    parts = 1 + len(record.kept) if lowers and record is not None else 0
    tried = parts * max((seconds_to_judge(trials, plan, LEARNED, lowers) for plan in new), default=0.0)
    return tried + sum(seconds_to_judge(trials, plan, lowered=lowers) for plan in new)


def seconds_to_time(kept: Kept, deadline_ms: float | None) -> float:
    """That timing takes: all plans in each precision, by a deadline two for longer; and to confirm what is chosen."""
    trials = kept.trials
    rounds = (WARM_UP + TIMED) * (1 if trials.artifact.manifest.precision is None else 2)
    slower = max(1.0, trials.clock.paces.get(True, 1.0))  # than when the loops were timed
    plans = [plan for name, plan in kept.plans.items() if name != FULL]
    a_round = sum(call_seconds(trials, plan) for plan in (*plans, *(plan for plan, _ in kept.farther.values())))
    confirming = sorted(seconds_to_judge(trials, plan, CONFIRMING) for plan in plans)
    return slower * rounds * a_round + 2 * TIMED_LONG * (deadline_ms or 0.0) / 1e3 + sum(confirming[-CHOSEN:])


def choose(kept: Kept, request: Request) -> Frontier:
    """Judge and time every plan, in each precision that it can have, and with all tokens, and choose.

    ``schedule`` is ``best_plan`` of those within ``Request.bound``, which are near enough, and the default; if there
    is none, it is the nearest within ``Request.farthest``, and ``dense`` the default. ``safe`` is the fastest that is
    near enough and a good deal nearer, and ``fast`` the fastest within ``Request.farthest``, where it saves more than
    what counts as equally fast. What was chosen is confirmed by calls that it was not chosen by: where it is further
    away than it may be on these, the next one is taken. What else may be it on another machine, or by another deadline,
    is kept as spare.

    Raises:
        CalibrationFailedError: no plan is within ``Request.farthest``, though there was time; or none that is near
            enough keeps the deadline, nor does ``dense``.
    """
    entrants, bound, farthest = _Entrants(kept, request), request.bound, request.farthest
    scores, within = entrants.scores, entrants.within
    short = bool(kept.trials.clock.left_out) and request.deadline_ms is None
    chosen, default = entrants.confirmed(bound, entrants.best), SCHEDULE
    if chosen is None:
        if not (allowed := entrants.near(farthest)):
            if not within or short:  # there was no time for any, or for a nearer one
                alone = {DENSE: kept.plans[DENSE]}
                return Frontier(entrants.rows({}, (), ()), alone, {}, {DENSE: scores[DENSE]}, DENSE)
            name = min(within, key=lambda n: scores[n].interval[1])
            raise CalibrationFailedError(too_far(kept.trials, request, name, scores[name]))
        chosen, default = entrants.nearest(allowed, entrants.near(bound)), DENSE
        entrants.holds(chosen, math.inf)  # however far away, so that it is told
    named, took = {chosen: SCHEDULE}, entrants.median(chosen)
    distance = entrants.distances[chosen]

    def nearer(close: Sequence[str]) -> str | None:
        slower = [n for n in close if entrants.median(n) > took and entrants.distances[n] <= SAFER * distance]
        return min(slower, key=entrants.median, default=None)

    def faster(allowed: Sequence[str]) -> str | None:
        times = {name: entrants.median(name) for name in allowed if ALIKE * entrants.median(name) < took}
        return fastest(times, entrants.distances) if times else None

    for name, most, pick in ((SAFE, bound, nearer), (FAST, farthest, faster)):
        if (found := entrants.confirmed(most, pick)) is not None:
            named[found] = name
    allowed = entrants.near(farthest)
    plans = {DENSE: kept.plans[DENSE], **{named[name]: entrants.plans[name] for name in named}}
    spare = entrants.spare(named, allowed)
    others = [plan.otherwise for plan in (*plans.values(), *spare.values())]
    plans |= {one: plan for one, plan in kept.plans.items() if any(plan is other for other in others)}
    kept.told["threads"] = entrants.told_of_threads(chosen)
    held = {**named, DENSE: DENSE} if default == DENSE else named
    judged = {held[name]: scores[name] for name in held} | {name: scores[name] for name in spare}
    return Frontier(entrants.rows(named, allowed, spare), plans, spare, judged, default)


class _Entrants:
    """The plans to choose among by name, judged and timed; ``within`` are their least bounds, but for ``dense``."""

    def __init__(self, kept: Kept, request: Request) -> None:
        self._trials, self._request = kept.trials, request
        bar, clock, flops = self._trials.bar, self._trials.clock, self._trials.artifact.manifest.flops
        dense = kept.plans[DENSE]  # which is 0 away from itself, without being asked once more
        assert dense.cells is not None
        saved = 1 - flops.call(dense.cells, pruned=False) / flops.dense
        same = Score(
            0.0, (0.0, 0.0), error=0.0, error_p90=0.0, sparsity=0.0, flops_sparsity=0.0, flops_saved=saved, plans=1
        )
        self.plans, self.scores = {DENSE: dense}, {DENSE: same}
        del clock.ahead[1:]  # but timing
        bar.stage("held-out calls", len(kept.plans))
        for name, plan in kept.plans.items():
            if name in (DENSE, FULL):
                continue
            for variant, one in _variants(name, plan).items():
                if (score := kept.known(name, one)) is None:
                    if not clock.has(seconds_to_judge(self._trials, one), one.in_words()):
                        continue
                    score = judge(self._trials, one)
                own = variant if name in self.plans else name  # the first takes the place of what was left out
                self.plans[own], self.scores[own] = one, score
                bar.update(len(self.plans), f"{own}: {score.distance:.3g}", clock.left())
        for name, (plan, score) in kept.farther.items():  # never chosen, and yet shown
            self.plans[name], self.scores[name] = plan, score
        bar.stage("timing", 1)
        each = timed([(self._trials, plan) for plan in self.plans.values()], request.threads)
        self.times = dict(zip(self.plans, each, strict=True))
        clock.ahead.clear()
        self._confirmed = dict[str, Score]()
        self._measured()

    def _measured(self) -> None:
        self.distances = {name: one.distance for name, one in self.scores.items()}
        self.within = {n: least_bound(one.distance, one.interval) for n, one in self.scores.items() if n != DENSE}

    def near(self, bound: float) -> list[str]:
        """Names of the plans that are surely within a bound."""
        return [name for name, least in self.within.items() if least <= bound]

    def median(self, name: str) -> float:
        """Milliseconds of a call."""
        return self.times[name].median

    def confirmed(self, bound: float, pick: Callable[[Sequence[str]], str | None]) -> str | None:
        """What is picked of the plans within a bound, and holds; until one does, or none is left."""
        while (name := pick(self.near(bound))) is not None and not self.holds(name, bound):
            pass
        return name

    def holds(self, name: str, bound: float) -> bool:
        """Whether a plan is within a bound on calls that it was not chosen by; if not, these say how far it is.

        Where there is no time to ask, it is as near as it seemed.
        """
        if name == DENSE:
            return True
        if (found := self._confirmed.get(name)) is None:
            seconds = seconds_to_judge(self._trials, self.plans[name], CONFIRMING)
            if not self._trials.clock.has(seconds, f"confirming {name!r}"):
                return True
            found = self._confirmed[name] = judge(self._trials, self.plans[name], CONFIRMING)
        if found.distance <= bound:
            return True
        words = f"{name!r} is {self.distances[name]:.3g} from the original on the calls that it was chosen by, and"
        self._trials.bar.warn(f"{words} {found.distance:.3g} on others: more than {bound:g}, so it is not chosen.")
        self.scores[name] = found
        self._measured()
        return False

    def best(self, names: Sequence[str]) -> str | None:
        """``best_plan`` of these; by a deadline the nearest are timed long enough to tell, two at a time."""
        if (deadline := self._request.deadline_ms) is None:
            return best_plan({name: self.times[name] for name in names}, self.distances, None)
        left = sorted((name for name in names if self.times[name].median <= deadline), key=self._nearness)
        for two in (left[n : n + 2] for n in range(0, len(left), 2)):
            again = timed([(self._trials, self.plans[name]) for name in two], self._request.threads, TIMED_LONG)
            self.times |= zip(two, again, strict=True)
            if (found := best_plan({name: self.times[name] for name in two}, self.distances, deadline)) is not None:
                return found
        return None

    def told_of_threads(self, name: str) -> str:
        """By how much calls of a plan are faster with two threads; nothing where they are not, or 36 take too long."""
        if self._request.threads > 1 or torch.get_num_threads() < 2 or self.median(name) > 40:
            return ""  # torch has as many as there are cores
        one, two = (timed([(self._trials, self.plans[name])], threads)[0].median for threads in (1, 2))
        told = f"with two a call of {SCHEDULE!r} takes {ms(two)} ms in place of {ms(one)}"
        return f"{told}: build with --threads 2, and load with threads=2" if ALIKE * two < one else ""

    def nearest(self, allowed: Sequence[str], close: Sequence[str]) -> str:
        """What is nearest of the plans that are not near enough; with a warning, since ``dense`` is the default."""
        deadline, bound = self._request.deadline_ms, self._request.bound
        keeping = [name for name in allowed if deadline is None or self.times[name].worst <= deadline]
        if deadline is not None and self.best([DENSE]) is None:
            raise CalibrationFailedError(self._too_late(deadline, keeping, close, allowed))
        in_time = "" if deadline is None else f" that keeps {deadline:.3g} ms"
        self._trials.bar.warn(
            f"no plan{in_time} is surely within {bound:g} of the original, so {DENSE!r} stays the default. What came"
            f" nearest is kept as {SCHEDULE!r}, to be asked for: where such plans were driven, some lost several points"
            " of success."
        )
        return min(keeping or allowed, key=self._nearness)

    def _too_late(self, deadline: float, keeping: Sequence[str], close: Sequence[str], allowed: Sequence[str]) -> str:
        """What is said where neither ``dense`` nor any plan that is near enough keeps the deadline."""
        near, in_time = f"surely within {self._request.bound:g} of the original", f"keeps {deadline:.3g} ms"
        larger = min((self.within[name] for name in keeping), default=None)
        if keeping and not close:  # it is not time that they lack
            name = min(keeping, key=self._nearness)
            first = f"no plan that {in_time} is {near}: the nearest"
            how = f"is {self.distances[name]:.3g} away, and {self.scores[name].interval[1]:.3g} at worst"
            told = would_help(self._trials, self._request, larger, also=("more time", "more episodes"))
        else:
            name = min(close or allowed, key=lambda n: self.times[n].worst)
            median, worst = self.times[name].median, self.times[name].worst
            first = f"no plan that is {near} {in_time}: the fastest"
            how = f"takes {median:.3g} ms, and {worst:.3g} at worst, {worst / deadline:.3g} times as long"
            told = would_help(self._trials, self._request, larger)
        return f"{first}, {name!r} ({self.plans[name].in_words()}), {how}. {told}"

    def _nearness(self, name: str) -> tuple[float, float]:
        return round(self.distances[name], 3), self.times[name].median

    def spare(self, named: Iterable[str], allowed: Sequence[str]) -> dict[str, Plan]:
        """Of what may be taken the frontier: each nearer by more than a fifth than what is faster by more than that.

        Without what the ``named`` plans are in another precision: any plan can be loaded in fp32 (``NAME@fp32``).
        """
        found, left = list[str](), {name: self.times[name].median for name in allowed}
        while left:
            found.append(fastest(left, self.distances))
            most = min(self.distances[found[-1]], self.distances[found[-1]] / ALIKE)  # an estimate may be below 0
            left = {name: took for name, took in left.items() if self.distances[name] < most}
        known = set(map(_base, named))
        spare = {name: self.plans[name] for name in map(_base, found) if name in allowed and name not in known}
        most = SMALL * self._trials.artifact.bytes
        return {name: plan for name, plan in spare.items() if _bytes(name, plan) <= most}

    def rows(self, named: dict[str, str], allowed: Sequence[str], spare: Iterable[str]) -> tuple[dict[str, Any], ...]:
        """See ``Frontier.tried``, given the names that plans get, and which may be taken."""
        return tuple(
            {
                "name": named.get(name, name),
                "told": self.plans[name].in_words(),
                "distance": self.distances[name],
                "interval": list(self.scores[name].interval),
                "within": self.within.get(name, 0.0),
                **self._second(name),
                "milliseconds": times.median,
                "worst": times.worst,
                "calls": len(times.ms),
                "weights": weights_read(self._trials.artifact, self.plans[name]),
                "near": name == DENSE or name in allowed,
                "kept": name == DENSE or name in named or name in spare,
                "spare": name in spare,
            }
            for name, times in sorted(self.times.items(), key=lambda one: one[1].median)
        )

    def _second(self, name: str) -> dict[str, Any]:
        """``confirmed`` of ``Frontier.tried``, where a plan was."""
        if (one := self._confirmed.get(name)) is None:
            return {}
        return {"confirmed": {"distance": one.distance, "interval": list(one.interval)}}


def _variants(name: str, plan: Plan) -> dict[str, Plan]:
    """A plan by its name, and without what other plans than it have gained by."""
    found = {name: plan}
    if plan.precision:
        found[f"{name}@fp32"] = replace(plan, precision={})
    if plan.tokens is not None:  # looking for changes may take longer than a small encoder
        found[f"{name}, all tokens"] = replace(plan, tokens=None)
        if plan.tokens.scene is not None:
            found[f"{name}, whole scene"] = replace(plan, tokens=replace(plan.tokens, scene=None))
    return found


def _base(name: str) -> str:
    """The plan that a variant of ``_Entrants.plans`` is of."""
    return name.partition("@")[0].partition(",")[0]


def _bytes(name: str, plan: Plan) -> int:
    """That a plan's correction takes."""
    arrays = {} if plan.correction is None else correction_arrays(name, plan.correction)
    return sum(one.nbytes for one in arrays.values())


def weights_read(artifact: Artifact, plan: Plan) -> int:
    """Bytes of the weights that a plan's models read, each counted once."""
    view = view_of(artifact, plan)
    pieces = [name for name in view.manifest.pieces if name != LAYERS and not is_of_loop(name)]
    return weight_bytes(artifact.files, {view.onnx_file(name) for name in pieces})
