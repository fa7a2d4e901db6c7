"""The plans of a calibration so far: what was proposed, held on held-out episodes, and will be written."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from ..artifact.ceiling import FARTHEST
from ..artifact.manifest import StartRecord, WeightsRecord
from ..artifact.stores import BlockWeights
from ..core.coercion import Arrays
from ..core.plan import DENSE, FULL, ORIGINAL, Plan
from ..errors import CalibrationFailedError
from ..measure.points import SAME
from .clock import Clock
from .judge import Score, further, judge
from .proposer import Proposal, Proposer
from .trials import Trials


class Kept:
    """See the module.

    Args:
        anew: whether to begin with the base of the calibration. Else with the artifact's plans, to which others come.
        farthest: how far from the original a plan may be that takes the place of a nearer default.

    Attributes:
        plans: that the artifact will have, by name, and ``default``, the name of the best so far.
        trials: of the artifact with all that is kept.
        scores: of the plans that were judged, and ``notes`` on how they were found, by name.
        judged: the plans that these scores are of, by name.
        exact: the same of plans while they were in fp32, with all tokens, with their scores.
        weights, starts: what plans name that the artifact had not, by name.
        pruner: constants, and the loop whose pruner has them; None where they stay.
        refused: why plans, or all that a proposer proposed, are left out, by name; begins with a verb.
        farther: those of these plans that were proposed beside others, with their scores, by name.
        told: by proposer, a sentence on what became of it; and one on ``threads``.
        shared: by proposer, the fields that it gave to all plans.
        learned: whether any proposal but those ``beside`` was kept.
    """

    def __init__(self, trials: Trials, anew: bool, farthest: float = FARTHEST) -> None:
        artifact = trials.artifact
        self.plans: dict[str, Plan] = {n: p for n, p in artifact.plans.items() if not anew or n in (DENSE, FULL)}
        first = next(n for n in (FULL, DENSE) if n in self.plans) if anew else artifact.manifest.default_plan
        self.default, self.trials, self._farthest = first, replace(trials, name=first), farthest
        self.scores: dict[str, Score] = {}
        self.judged: dict[str, Plan] = {}
        self.exact: dict[str, tuple[Plan, Score]] = {}
        self.notes: dict[str, Mapping[str, Any]] = {}
        self.weights: dict[str, BlockWeights] = {}
        self.starts: dict[str, StartRecord] = {}
        self.pruner: tuple[Arrays, str] | None = None
        self.refused: dict[str, str] = {}
        self.farther: dict[str, tuple[Plan, Score]] = {}
        self.told: dict[str, str] = {}
        self.shared: dict[str, dict[str, Any]] = {}
        self.learned = False

    @property
    def plan(self) -> Plan:
        """The best so far."""
        return self.plans[self.default]

    def hear(self, name: str, proposer: Proposer, clock: Clock) -> None:
        """Judge what a proposer proposes, one plan after the other.

        Raises:
            CalibrationFailedError: it has nothing to propose, and nobody before it had.
        """
        proposals, refusal, held = proposer.propose(self.trials, self.plan, clock), None, False
        shared = self.shared[name] = {}
        try:
            proposal = next(proposals)
            while True:
                refusal = self.consider(proposal)
                if refusal is None:
                    held = True
                    shared |= proposal.shared
                proposal = proposals.send(refusal is None)
        except StopIteration:
            # A change of a plan has the plan's name, so that nothing says of the name that the change was refused.
            if refusal is not None and not held and proposal.name in self.judged:
                self.refused[name], self.told[name] = refusal, ""
                return
        except CalibrationFailedError as error:
            if not self.learned:
                raise
            self.refused[name] = f"has nothing to propose: {error}"
        self.told[name] = proposer.told

    def judge_changed(self, before: Mapping[str, Plan]) -> None:
        """Judge plans anew that were given a field after they were judged, here or by the calibration ``before``."""
        for name, plan in self.plans.items():
            if name != DENSE and self.judged.get(name, before.get(name)) is not plan:
                self.scores[name] = judge(self.trials, plan)

    def keep_only(self, plans: Mapping[str, Plan], scores: Mapping[str, Score], default: str) -> None:
        """Have no other plans than these, and tell of what was given to all plans that none of these has."""
        self.plans, self.scores, self.default = dict(plans), dict(scores), default
        for name, given in self.shared.items():
            if given and not any(getattr(plan, key) == given[key] for plan in plans.values() for key in given):
                self.told[name] += ", and no chosen plan is faster by it"

    def known(self, name: str, plan: Plan) -> Score | None:
        """The score of a plan that was judged under this name, or before it got a precision and tokens."""
        if self.judged.get(name) is plan:
            return self.scores[name]
        if name not in self.exact or plan.exact is not plan:
            return None
        before, score = self.exact[name]
        others = (field.name for field in fields(Plan) if field.name not in ("precision", "tokens"))
        return score if all(getattr(plan, one) is getattr(before, one) for one in others) else None

    def consider(self, proposal: Proposal) -> str | None:
        """Judge a proposal on held-out episodes, and keep it if it holds; else why it does not."""
        trials = holding(self.trials, proposal)
        score = self.known(proposal.name, proposal.plan) or judge(trials, proposal.plan)
        reason = proposal.refusal(score, self.scores)
        if reason is None and not proposal.beside:
            reason = self._no_better(trials, score, proposal.margin)
        if reason is not None:
            if proposal.name not in self.judged:  # one of that name that was kept before stays
                self.refused[proposal.name] = reason
                if proposal.beside:
                    self.farther[proposal.name] = proposal.plan, score
            return reason
        self.refused.pop(proposal.name, None)
        self.farther.pop(proposal.name, None)
        self.plans[proposal.name], self.scores[proposal.name] = proposal.plan, score
        self.judged[proposal.name] = proposal.plan
        if proposal.plan.exact is proposal.plan:
            self.exact[proposal.name] = proposal.plan, score
        self.notes[proposal.name] = proposal.notes
        self.weights |= proposal.weights
        self.starts |= proposal.starts
        if proposal.pruner is not None:
            self.pruner = proposal.pruner, proposal.plan.loop
        if proposal.shared:
            self._share(proposal)
        if not proposal.beside:
            self.learned = True
            if not self._default_stays(proposal, score):
                self.default = proposal.name
        if self.plan.loop in trials.artifact.manifest.spec.all_loops:
            trials = trials.of_loop(self.plan.loop)  # so that who trains weights learns from its calls
        self.trials = replace(trials, name=self.default)
        return None

    def _default_stays(self, proposal: Proposal, score: Score) -> bool:
        """Whether scores may fall with a plan, and not with the default: then that stays what it is.

        A plan that was asked for whatever it costs (a margin without end) becomes the default, with a warning.
        """
        if proposal.margin == float("inf") or not score.distance > self._farthest >= self.scores[self.default].distance:
            return False
        self.trials.bar.warn(
            f"plan {proposal.name!r} is kept, and {self.default!r} stays the default: {proposal.name!r} is"
            f" {score.distance:.2f} of what other noise changes from the original, and above {self._farthest:g} scores"
            " may fall. Drive your task with it before you load it by its name."
        )
        return True

    def _no_better(self, trials: Trials, score: Score, margin: float | None) -> str | None:
        """Why a plan does not take the place of the best one so far."""
        if margin == float("inf"):  # asked for, whatever it costs
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
    pruners = dict(artifact.pruners)
    if proposal.pruner is not None:
        pruners[loop if loop in pruners else ORIGINAL] = proposal.pruner
    held = replace(
        artifact,
        manifest=replace(manifest, starts={**manifest.starts, **proposal.starts}, weights=known),
        block_weights={**artifact.block_weights, **added},
        pruners=pruners,
    )
    return replace(trials, artifact=held, fresh=trials.fresh or bool(added) or proposal.pruner is not None)
