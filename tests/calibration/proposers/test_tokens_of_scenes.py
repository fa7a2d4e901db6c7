"""Of a scene, too, how few tokens do is chosen by what it does to the actions."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

from tests.calibration.proposers.trying import proposed, recorded, request, trials_of
from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.towers import TokensRecord
from ttscompile.calibration.judge import Score
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.proposers import tokens
from ttscompile.calibration.proposers.tokens import SCENES, Tokens
from ttscompile.calibration.trials import Trials
from ttscompile.core.plan import Plan, TokenReuse
from ttscompile.errors import CalibrationFailedError
from ttscompile.ir.pieces import SCENE
from ttscompile.measure.timer import Times

pytestmark = pytest.mark.slow

NEAR, FAR = 0.9 * Tokens.margin, 1.1 * Tokens.margin


@pytest.fixture(scope="module")
def trials(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Trials:
    """Of a policy whose manifest says that it has a scene with tokens."""
    files = recorded(tmp_path_factory.mktemp("still") / "calls.npz")
    own = trials_of(cameras.compiled_tokens(once) / "artifact", files)
    return with_tokens(own, {**own.artifact.manifest.tokens, SCENE: TokensRecord(80, 0, (1, 8), {}, (78, 79))})


def with_tokens(trials: Trials, records: Mapping[str, TokensRecord]) -> Trials:
    manifest = replace(trials.artifact.manifest, tokens=records)
    return replace(trials, artifact=replace(trials.artifact, manifest=manifest))


def tried(trials: Trials, monkeypatch: pytest.MonkeyPatch, limits: Mapping[TokenReuse, float]) -> Proposal:
    """What is proposed where these settings are so much further off at most, and all others far."""

    def scored(trials: object, plan: Plan, part: str) -> Score:
        far = 0.0 if plan.tokens is None else limits.get(plan.tokens, 9.0)
        return Score(far, (0, 0), None, None, 0, 0, 0, 1, tokens=0.4)

    monkeypatch.setattr(tokens, "judge", scored)
    monkeypatch.setattr(tokens, "further", lambda one, _: (one.distance / 2, one.distance))
    monkeypatch.setattr(tokens, "timed", lambda entrants, threads: [Times((2.0,)), Times((1.0,))])
    (found,) = proposed(Tokens(request()), trials, trials.base)
    return found


def test_the_largest_share_that_is_near_is_taken(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    towers = TokenReuse(0.0, 6)
    limits = {towers: 0.0, replace(towers, scene=SCENES[0]): FAR, replace(towers, scene=SCENES[1]): NEAR}
    found = tried(trials, monkeypatch, limits)
    assert found.plan.tokens == replace(towers, scene=SCENES[1])
    assert found.shared == {"tokens": found.plan.tokens} and found.notes["scene"] == SCENES[1]


def test_where_no_share_is_near_scenes_are_whole(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tried(trials, monkeypatch, {TokenReuse(0.0, 6): 0.0}).plan.tokens == TokenReuse(0.0, 6)


def test_a_scene_may_be_all_that_has_tokens(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = with_tokens(trials, {SCENE: trials.artifact.manifest.tokens[SCENE]})
    assert Tokens(request()).applies(alone.artifact) is None
    found = tried(alone, monkeypatch, {TokenReuse(0.0, 6, SCENES[-1]): NEAR})
    assert found.plan.tokens == TokenReuse(0.0, 6, SCENES[-1])
    with pytest.raises(CalibrationFailedError, match="further off at least"):
        tried(alone, monkeypatch, {})


def test_too_many_tokens_are_refused_with_a_scene_too(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokens, "MOST_COMPUTED", 0.3)
    with pytest.raises(CalibrationFailedError, match="would compute 40% of the tokens"):
        tried(trials, monkeypatch, {TokenReuse(0.0, 6): 0.0})
