"""The plans of a calibration so far: what was proposed, held on held-out episodes, and will be written.

Of a build also which of them is the default: all of them judged and timed, in one run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy.typing as npt

from ..artifact.manifest import StartRecord, WeightsRecord
from ..artifact.stores import BlockWeights
from ..core.plan import DENSE, FULL, Plan
from ..errors import CalibrationFailedError
from ..measure.points import ALIKE, SAME, Point, best_plan, efficient
from ..measure.timer import Times
from .judge import Score, further, judge, timed
from .proposer import SAFER, Proposal, Request, near
from .proposers.loops import too_far
from .schedule import SCHEDULE
from .step_counts import FAST, SAFE
from .trials import Trials


class Kept:
    """See the module.

    Args:
        anew: whether to begin with the base of the calibration. Else with the artifact's plans, to which others come.

    Attributes:
        trials: of the artifact with all that is kept.
        judged: the plans that these scores are of, by name.
        pruner: constants, and the loop whose pruner has them; None where they stay.
        refused: why plans are left out, by name.
        learned: whether any proposal but those ``beside`` was kept.
    """

    def __init__(self, trials: Trials, anew: bool) -> None:
        artifact = trials.artifact
        self.plans: dict[str, Plan] = {n: p for n, p in artifact.plans.items() if not anew or n in (DENSE, FULL)}
        first = next(n for n in (FULL, DENSE) if n in self.plans) if anew else artifact.manifest.default_plan
        self.default, self.trials = first, replace(trials, name=first)
        self.scores: dict[str, Score] = {}
        self.judged: dict[str, Plan] = {}
        self.notes: dict[str, Mapping[str, Any]] = {}
        self.weights: dict[str, BlockWeights] = {}
        self.starts: dict[str, StartRecord] = {}
        self.pruner: tuple[Mapping[str, npt.NDArray[Any]], str] | None = None
        self.refused: dict[str, str] = {}
        self.learned = False

    @property
    def plan(self) -> Plan:
        """The best so far."""
        return self.plans[self.default]

    def consider(self, proposal: Proposal) -> bool:
        """Judge a proposal on held-out episodes, and keep it if it holds."""
        trials = holding(self.trials, proposal)
        score = judge(trials, proposal.plan)
        reason = proposal.refusal(score, self.scores)
        if reason is None and not proposal.beside:
            reason = self._no_better(trials, score, proposal.margin)
        if reason is not None:
            if proposal.name not in self.judged:  # one of that name that was kept before stays
                self.refused[proposal.name] = reason
            return False
        self.refused.pop(proposal.name, None)
        self.plans[proposal.name], self.scores[proposal.name] = proposal.plan, score
        self.judged[proposal.name] = proposal.plan
        self.notes[proposal.name] = proposal.notes
        self.weights |= proposal.weights
        self.starts |= proposal.starts
        if proposal.pruner is not None:
            self.pruner = proposal.pruner, proposal.plan.loop
        if proposal.shared:
            self._share(proposal)
        if not proposal.beside:
            self.default, self.learned = proposal.name, True
        if self.plan.loop in trials.artifact.manifest.spec.all_loops:
            trials = trials.of_loop(self.plan.loop)  # so that who trains weights learns from its calls
        self.trials = replace(trials, name=self.default)
        return True

    def _no_better(self, trials: Trials, score: Score, margin: float | None) -> str | None:
        """Why a plan does not take the place of the best one so far."""
        if margin == float("inf"):
            return None
        if self.default not in self.scores:
            self.scores[self.default] = judge(self.trials, self.plan)
        best = judge(trials, self.plan) if trials.fresh else self.scores[self.default]
        difference, limit = further(score, best)
        told = f"its distance from the original is {score.distance:.4g} on held-out calls, and that of {self.default!r}"
        if margin is None:
            return None if difference < -SAME * best.distance else f"is no better: {told} {best.distance:.4g}."
        if limit <= margin:
            return None
        return f"is too far off: {told} {best.distance:.4g}: {limit:.4g} more at worst, and {margin:.4g} is allowed."

    def _share(self, proposal: Proposal) -> None:
        """Give the fields that a proposal shares to all plans but ``dense``, also where one falls back on another."""
        old, new = dict(self.plans), dict[int, Plan]()
        for name, plan in old.items():
            fields = {} if name in (DENSE, proposal.name) else proposal.shared
            new[id(plan)] = replace(plan, **fields) if fields else plan
        for name, plan in old.items():
            made = new[id(plan)]
            if made.otherwise is not None:
                made = replace(made, otherwise=new.get(id(made.otherwise), made.otherwise))
            self.plans[name] = made


def holding(trials: Trials, proposal: Proposal) -> Trials:
    """The same, of an artifact that holds in memory what a proposal brings."""
    artifact, manifest, loop = trials.artifact, trials.artifact.manifest, proposal.plan.loop
    added = {name: own.weights for name, own in proposal.weights.items()}
    known = {**manifest.weights, **{name: WeightsRecord(name, {}, None, {}) for name in added}}
    pruner, pruners = artifact.pruner, dict(artifact.loop_pruners)
    if proposal.pruner is not None and loop in pruners:
        pruners[loop] = proposal.pruner
    elif proposal.pruner is not None:
        pruner = proposal.pruner
    held = replace(
        artifact,
        manifest=replace(manifest, starts={**manifest.starts, **proposal.starts}, weights=known),
        block_weights={**artifact.block_weights, **added},
        pruner=pruner,
        loop_pruners=pruners,
    )
    return replace(trials, artifact=held, fresh=trials.fresh or bool(added) or proposal.pruner is not None)


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
    """Judge and time every plan, in each precision that it can have, and choose.

    The default is ``best_plan`` of those within ``Request.farthest``, where those within ``Request.bound`` are near
    enough; there is a warning if it is not one of them. ``schedule`` is the name of the default, ``safe`` that of the
    fastest plan that is near enough and a good deal nearer, and ``fast`` that of the next faster one that is not too
    far.

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
    kept.trials.bar.stage("held-out calls", len(entered))
    for number, (name, plan) in enumerate(entered.items(), 1):
        if kept.judged.get(name) is plan:
            scores[name] = kept.scores[name]
        else:
            scores[name] = judge(kept.trials, plan)
        kept.trials.bar.update(number, f"{name}: {scores[name].distance:.3g}", kept.trials.clock.left())
    kept.trials.bar.stage("timing", 1)
    times = dict(zip(entered, timed([(kept.trials, plan) for plan in entered.values()], request.threads), strict=True))
    points = {name: Point("", name, scores[name].distance, times[name].median) for name in entered}
    best = {point.name for point in efficient(list(points.values()))}

    def up_to(bound: float) -> list[str]:
        return [n for n, one in scores.items() if n != DENSE and near(one.distance, one.interval, bound)]

    allowed, close = up_to(request.farthest), up_to(request.bound)
    chosen = _chosen(close, allowed, scores, times, request)
    named = {chosen: SCHEDULE}
    others = [name for name in best if name not in (DENSE, chosen)]
    wanted = SAFER * scores[chosen].distance
    if nearer := [name for name in others if name in allowed and scores[name].distance <= wanted]:
        named[min(nearer, key=lambda name: times[name].median)] = SAFE
    faster = [name for name in others if ALIKE * times[name].median < times[chosen].median]
    if within := [name for name in faster if scores[name].distance <= request.farthest]:
        named[max(within, key=lambda name: times[name].median)] = FAST
    plans = {named[name]: entered[name] for name in named}
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
            "on_frontier": name in best,
            "kept": name == DENSE or name in named,
        }
        for name in sorted(entered, key=lambda one: times[one].median)
    ]
    if chosen not in close:
        in_time = "" if request.deadline_ms is None else f" that keeps {request.deadline_ms:.3g} ms"
        kept.trials.bar.warn(
            f"no plan{in_time} is within {request.bound:g} of the original: the default is"
            f" {scores[chosen].distance:.2g} away, and {scores[chosen].interval[1]:.2g} at worst. Such plans lost"
            " several points of success where they were driven. Evaluate it, record more episodes, or allow more time."
        )
    plans = {DENSE: kept.plans[DENSE], **plans}
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
