"""When a token of an encoder or of the scene is computed anew: the setting with the fewest, of those that are near."""

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from ...artifact.load import Artifact
from ...core.plan import Plan, TokenReuse
from ...errors import CalibrationFailedError
from ...ir.pieces import SCENE
from ...measure.points import ALIKE
from ..clock import Clock
from ..judge import Score, further, judge, timed
from ..proposer import Proposal, Proposals, Proposer
from ..trials import LEARNED, Trials

THRESHOLDS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Differences that are tried, ascending. Encoders read pixels with a deviation of about one."""
SCENES = (0.4, 0.2, 0.1, 0.05)
"""Shares of a scene's rows that are tried, descending: words are computed anyway, so most of these change little."""
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
        """Whether an encoder, or the scene, has tokens."""
        if artifact.manifest.tokens:
            return None
        problem = "no image encoder of this policy is a vision transformer whose tokens could be reused, and its scene"
        return f"{problem} has none; 'ttscompile convert --explain' says why"

    def propose(self, trials: Trials, plan: Plan, clock: Clock) -> Proposals:
        """The plan, with the setting that computes the fewest tokens."""
        seen = max(last - first + 1 for _, first, last in trials.learned.stretches.tolist())
        refreshes = sorted({min(refresh, seen) for refresh in REFRESHES}, reverse=True)
        own = trials.artifact.manifest.tokens
        thresholds = THRESHOLDS if set(own) - {SCENE} else ()  # where whole frames are computed, only those of scenes
        settings = [TokenReuse(threshold, refresh) for refresh in refreshes for threshold in thresholds]
        scenes = SCENES if SCENE in own else ()
        all_tokens = replace(plan, tokens=None)
        if self.request.by_time:
            fewest = TokenReuse(THRESHOLDS[-1], refreshes[0], *scenes[:1])
            self._require_faster(trials, all_tokens, replace(plan, tokens=fewest))
        whole, tried = judge(trials, all_tokens, LEARNED), list[tuple[float, Score, TokenReuse]]()
        trials.bar.stage("settings of tokens", len(settings) + len(scenes))
        too_far = dict[int, float]()

        def try_one(setting: TokenReuse) -> tuple[float, float]:
            """By how much further off the actions are, and at most."""
            score = judge(trials, replace(plan, tokens=setting), LEARNED)
            off, limit = further(score, whole)
            tried.append((limit, score, setting))
            trials.bar.update(len(tried), f"{score.tokens:.0%} computed", clock.left())
            return off, limit

        for setting in clock.in_time(settings):
            if setting.threshold > too_far.get(setting.refresh, np.inf):
                continue  # a larger threshold changes more
            if try_one(setting)[0] > self.margin:
                too_far[setting.refresh] = setting.threshold
        good = [(score, setting) for limit, score, setting in tried if limit <= self.margin]
        # Of equals the smallest threshold, and the rarest refresh.
        best = min(good, key=lambda one: one[0].tokens) if good else (whole, TokenReuse(0.0, refreshes[0]))
        for share in clock.in_time(scenes if good or not settings else ()):  # of the rows that encoders give so
            if try_one(replace(best[1], scene=share))[1] <= self.margin:
                good = [best := tried[-1][1:]]
                break
        if not good:
            least = min(limit for limit, _, _ in tried)
            raise _refused(f"the actions are {least:.3g} further off at least, and {self.margin:g} is allowed")
        score, setting = best
        if (told := _too_many(score, {})) is not None:
            raise _refused(f"it {told}")
        of = "new frames" + " and scenes" * (setting.scene is not None)
        self.told = f"on the calls that it was chosen on, {score.tokens:.0%} of the tokens of {of} are computed"
        notes, made = {**asdict(setting), "computed": score.tokens}, replace(plan, tokens=setting)
        if not self.request.by_time:
            self._warn_if_slower(trials, all_tokens, made)
        shared = {"tokens": setting}
        yield Proposal(trials.changed_name, made, notes, margin=self.margin, shared=shared, refusal=_too_many)

    def _require_faster(self, trials: Trials, all_tokens: Plan, fewest: Plan) -> None:
        """Raise unless a plan with the fewest tokens may be chosen for its time, as that of a small encoder may not.

        Then nothing is judged: of many settings that takes longer than all else that a build does.
        """
        whole, few = self._milliseconds(trials, all_tokens, fewest)
        if (ALIKE if self.request.deadline_ms is None else 1) * few >= whole:
            told = f"a call takes {whole:.3g} ms with all tokens, and {few:.3g} with the fewest"
            raise CalibrationFailedError(f"looking for changes saves too little: {told}")

    def _warn_if_slower(self, trials: Trials, all_tokens: Plan, made: Plan) -> None:
        """A calibration chooses by no clock, so it says what a build would have left out for its time."""
        whole, few = self._milliseconds(trials, all_tokens, made)
        if few >= whole:
            told = f"a call takes {few:.3g} ms here if tokens are reused, and {whole:.3g} if all are computed"
            trials.bar.warn(f"{told}: these encoders are too small for it. 'ttscompile build' leaves it out then.")

    def _milliseconds(self, trials: Trials, *plans: Plan) -> list[float]:
        return [one.median for one in timed([(trials, plan) for plan in plans], self.request.threads)]


def _too_many(score: Score, others: Mapping[str, Score]) -> str | None:
    if score.tokens <= MOST_COMPUTED:
        return None
    return f"would compute {score.tokens:.0%} of the tokens all the same"


def _refused(why: str) -> CalibrationFailedError:
    remedy = "Record with a camera that stands still, or allow more."
    return CalibrationFailedError(f"reusing tokens does not pay: {why}. {remedy}")
