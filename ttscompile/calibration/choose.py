"""Which of the plans that were kept is the default: all of them judged and timed, in one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..core.plan import DENSE, FULL, SCHEDULE, Plan
from ..errors import CalibrationFailedError
from ..measure.points import ALIKE, Point, best_plan, efficient, fastest
from ..measure.timer import Times
from .judge import Score, judge, timed
from .kept import Kept
from .proposer import SAFER, Request, near
from .proposers.loops import too_far
from .step_counts import FAST, SAFE


@dataclass(frozen=True)
class Frontier:
    """What was tried, and what was chosen.

    Attributes:
        tried: all plans, fastest first, the original among them; JSON. ``name`` is that in the artifact, or what it was
            called while it was tried; ``told`` what it does, in words; ``distance`` and ``interval`` how far it is from
            the original on held-out episodes, with 95 % limits (``judge``); ``milliseconds`` and ``worst`` the median
            and the longest of its calls on this machine, in milliseconds; ``near`` whether it is within
            ``Request.farthest``; ``on_frontier`` whether no other is faster and nearer; ``kept`` whether the artifact
            gets it.
        plans: that the artifact gets, by name; ``schedule`` is the default.
    """

    tried: tuple[dict[str, Any], ...]
    plans: dict[str, Plan]
    scores: dict[str, Score]


def choose(kept: Kept, request: Request) -> Frontier:
    """Judge and time every plan, in each precision that it can have, and with all tokens, and choose.

    The default is ``best_plan`` of those within ``Request.farthest``, where those within ``Request.bound`` are near
    enough; there is a warning if it is not one of them. ``schedule`` is the name of the default, ``safe`` that of the
    fastest plan that is near enough and a good deal nearer, and ``fast`` that of the fastest within
    ``Request.farthest``, where it saves more than what counts as equally fast.

    Raises:
        CalibrationFailedError: no plan is near enough, or none of those keeps the deadline; says what the nearest does.
    """
    entered, scores = {DENSE: kept.plans[DENSE]}, dict[str, Score]()
    for name, plan in kept.plans.items():
        if name in (DENSE, FULL):
            continue
        entered[name] = plan
        if plan.precision:
            entered[f"{name}@fp32"] = replace(plan, precision={})
        if plan.tokens is not None:  # looking for changes may take longer than a small encoder
            entered[f"{name}, all tokens"] = replace(plan, tokens=None)
    kept.trials.bar.stage("held-out calls", len(entered))
    for number, (name, plan) in enumerate(entered.items(), 1):
        scores[name] = kept.scores[name] if kept.judged.get(name) is plan else judge(kept.trials, plan)
        kept.trials.bar.update(number, f"{name}: {scores[name].distance:.3g}", kept.trials.clock.left())
    kept.trials.bar.stage("timing", 1)
    times = dict(zip(entered, timed([(kept.trials, plan) for plan in entered.values()], request.threads), strict=True))
    points = {name: Point("", name, scores[name].distance, times[name].median) for name in entered}
    on_frontier = {point.name for point in efficient(list(points.values()))}

    def up_to(bound: float) -> list[str]:
        return [n for n, one in scores.items() if n != DENSE and near(one.distance, one.interval, bound)]

    allowed, close = up_to(request.farthest), up_to(request.bound)
    chosen = _chosen(close, allowed, scores, times, request)
    named = {chosen: SCHEDULE}
    wanted, took = SAFER * scores[chosen].distance, times[chosen].median
    slower = [name for name in close or allowed if times[name].median > took]
    if nearer := [name for name in slower if scores[name].distance <= wanted]:
        named[min(nearer, key=lambda name: times[name].median)] = SAFE
    faster = {name: times[name].median for name in allowed if ALIKE * times[name].median < times[chosen].median}
    if faster:
        named[fastest(faster, {name: scores[name].distance for name in faster})] = FAST
    plans = {DENSE: kept.plans[DENSE], **{named[name]: entered[name] for name in named}}
    plans |= {one: plan for one, plan in kept.plans.items() if any(plan is other.otherwise for other in plans.values())}
    tried = [
        {
            "name": named.get(name, name),
            "told": entered[name].in_words(),
            "distance": scores[name].distance,
            "interval": list(scores[name].interval),
            "milliseconds": times[name].median,
            "worst": max(times[name].ms),
            "near": name == DENSE or name in allowed,
            "on_frontier": name in on_frontier,
            "kept": name == DENSE or name in named,
        }
        for name in sorted(entered, key=lambda one: times[one].median)
    ]
    if chosen not in close:
        in_time = "" if request.deadline_ms is None else f" that keeps {request.deadline_ms:.3g} ms"
        kept.trials.bar.warn(
            f"no plan{in_time} is surely within {request.bound:g} of the original: the default is"
            f" {scores[chosen].distance:.2g} away, and {scores[chosen].interval[1]:.2g} at worst. Such plans lost"
            " several points of success where they were driven. Evaluate it, record more episodes, or allow more time."
        )
    return Frontier(tuple(tried), plans, {named[name]: scores[name] for name in named})


def _chosen(
    close: Sequence[str],
    allowed: Sequence[str],
    scores: Mapping[str, Score],
    times: Mapping[str, Times],
    request: Request,
) -> str:
    if not allowed:
        name = min((n for n in scores if n != DENSE), key=lambda n: scores[n].interval[1])
        raise CalibrationFailedError(too_far(name, scores[name], request.farthest))
    distances = {name: scores[name].distance for name in allowed}
    chosen = best_plan({name: times[name] for name in allowed}, distances, close, request.deadline_ms)
    if chosen is None:
        name = min(allowed, key=lambda name: max(times[name].ms))
        raise CalibrationFailedError(
            f"no plan that is near enough keeps {request.deadline_ms:.3g} ms: the fastest, {name!r}, took"
            f" {times[name].median:.3g} ms, and {max(times[name].ms):.3g} at worst, with {request.threads} thread"
            f"{'s' * (request.threads > 1)}. Allow more threads, a larger error, or a slower loop."
        )
    return chosen
