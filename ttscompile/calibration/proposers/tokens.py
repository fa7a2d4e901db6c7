"""When a token of an image encoder is computed anew: the setting that computes the fewest, of those that are near."""

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from ...artifact.load import Artifact
from ...core.plan import Plan, TokenReuse
from ...errors import CalibrationFailedError
from ...measure.points import ALIKE
from ..clock import Clock
from ..judge import Score, further, judge, timed
from ..proposer import Proposal, Proposals, Proposer
from ..trials import LEARNED, Trials

THRESHOLDS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Differences that are tried, ascending. Encoders read pixels with a deviation of about one."""
REFRESHES = (32, 16, 12, 8, 4)
"""Of so many new frames one is whole; never of more than follow each other where plans are judged."""
MOST_COMPUTED = 0.75
"""Share of the tokens: where more are computed, looking for changes costs about what it saves."""


class Tokens(Proposer):
    """Tries thresholds and refreshes on consecutive calls.

    The best of many settings is one that was lucky, so the upper limit of its difference over episodes has to be within
    the margin already where it is chosen.
    """

    margin = 0.1
    """Of what other noise changes."""

    def applies(self, artifact: Artifact) -> str | None:
        """Whether an encoder has tokens."""
        if artifact.manifest.tokens:
            return None
        problem = "no image encoder of this policy is a vision transformer, whose tokens could be reused"
        return f"{problem}; 'ttscompile convert --explain' says of each encoder why"

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """The plan, with the setting that computes the fewest tokens."""
        seen = max(last - first + 1 for _, first, last in trials.learned.stretches.tolist())
        refreshes = sorted({min(refresh, seen) for refresh in REFRESHES}, reverse=True)
        settings = [TokenReuse(threshold, refresh) for refresh in refreshes for threshold in THRESHOLDS]
        all_tokens = replace(plan, tokens=None)
        if self.request.by_time:
            self._require_faster(trials, all_tokens, replace(plan, tokens=TokenReuse(THRESHOLDS[-1], refreshes[0])))
        whole, tried = judge(trials, all_tokens, LEARNED), list[tuple[float, Score, Plan]]()
        trials.bar.stage("settings of tokens", len(settings))
        too_far = dict[int, float]()
        for number, setting in enumerate(clock.in_time(settings), 1):
            if setting.threshold > too_far.get(setting.refresh, np.inf):
                continue  # a larger threshold changes more
            one = replace(plan, tokens=setting)
            score = judge(trials, one, LEARNED)
            off, limit = further(score, whole)
            tried.append((limit, score, one))
            if off > self.margin:
                too_far[setting.refresh] = setting.threshold
            trials.bar.update(number, f"{score.tokens:.0%} computed", clock.left())
        good = [(score, one) for limit, score, one in tried if limit <= self.margin]
        if not good:
            least = min(limit for limit, _, _ in tried)
            raise _refused(f"the actions are {least:.3g} further off at least, and {self.margin:g} is allowed")
        score, best = min(good, key=lambda one: one[0].tokens)  # of equals the smallest threshold, the rarest refresh
        if (told := _too_many(score, {})) is not None:
            raise _refused(f"it {told}")
        assert best.tokens is not None
        self.told = f"on the calls that it was chosen on, {score.tokens:.0%} of the tokens of new frames are computed"
        notes, shared = {**asdict(best.tokens), "computed": score.tokens}, {"tokens": best.tokens}
        yield Proposal(trials.changed_name, best, notes, margin=self.margin, shared=shared, refusal=_too_many)

    def _require_faster(self, trials: Trials, all_tokens: Plan, fewest: Plan) -> None:
        """Raise unless a plan with the fewest tokens may be chosen for its time, as that of a small encoder may not.

        Then nothing is judged: of many settings that takes longer than all else that a build does.
        """
        whole, few = (one.median for one in timed([(trials, all_tokens), (trials, fewest)], self.request.threads))
        if (ALIKE if self.request.deadline_ms is None else 1) * few >= whole:
            told = f"a call takes {whole:.3g} ms with all tokens, and {few:.3g} with the fewest"
            raise CalibrationFailedError(f"looking for changes saves too little: {told}")


def _too_many(score: Score, others: Mapping[str, Score]) -> str | None:
    if score.tokens <= MOST_COMPUTED:
        return None
    return f"would compute {score.tokens:.0%} of the tokens all the same"


def _refused(why: str) -> CalibrationFailedError:
    remedy = "Record with a camera that stands still, or allow more."
    return CalibrationFailedError(f"reusing tokens does not pay: {why}. {remedy}")
