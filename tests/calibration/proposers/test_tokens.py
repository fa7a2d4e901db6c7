"""When tokens are reused is chosen by what it does to the actions."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import TIMED, WARM_UP, Score, further, judge, timed
from ttscompile.calibration.kept import Kept
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.proposers import tokens
from ttscompile.calibration.proposers.tokens import MOST_COMPUTED, Tokens
from ttscompile.calibration.trials import HELD_OUT, Trials
from ttscompile.core.plan import DENSE, FULL, Plan, TokenReuse
from ttscompile.errors import CalibrationFailedError
from ttscompile.measure.timer import Times
from ttscompile.runtimes.runtime import Runtime
from ttscompile.verification import verify

from .trying import proposed, recorded, request, trials_of

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(once: Once, tmp_path: Path) -> Path:
    """An artifact of its own for each test."""
    return shutil.copytree(cameras.compiled_tokens(once) / "artifact", tmp_path / "own")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The camera does not move."""
    return recorded(tmp_path_factory.mktemp("still") / "calls.npz")


@pytest.fixture(scope="module")
def trials(once: Once, files: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Trials:
    """Of ``files``; an artifact and answers that no test changes."""
    folder = tmp_path_factory.mktemp("tokens") / "own"
    return trials_of(shutil.copytree(cameras.compiled_tokens(once) / "artifact", folder), files)


@pytest.fixture(scope="module")
def found(trials: Trials) -> Proposal:
    """What is proposed for them."""
    return tried(trials)


def tried(trials: Trials, **fields: float) -> Proposal:
    (found,) = proposed(Tokens(request(**fields)), trials, trials.base)
    return found


def test_what_is_proposed_saves_and_is_near_on_other_episodes(trials: Trials, found: Proposal) -> None:
    assert found.plan.tokens is not None and found.shared == {"tokens": found.plan.tokens}
    assert found.plan.tokens.refresh == 6, "that of 64 was never seen in episodes of six calls"
    assert (found.name, found.margin) == (FULL, Tokens.margin)
    whole, score = judge(trials, trials.base, HELD_OUT), judge(trials, found.plan, HELD_OUT)
    assert 5 / 37 <= score.tokens < 0.5
    assert whole.tokens == 1
    assert further(score, whole)[0] < 2 * Tokens.margin
    assert found.plan.cells is trials.base.cells and found.plan.precision == trials.base.precision


def test_tokens_that_no_chosen_plan_reuses_are_said_to_be_of_no_use(
    folder: Path, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looking for changes may take longer than a call showed at first, so that no plan may take what was learned."""

    def timed(entrants: Any, threads: int) -> list[Times]:
        return [Times((10.0 if plan.tokens is None else slower,)) for _, plan in entrants]

    monkeypatch.setattr("ttscompile.calibration.choose.timed", timed)
    monkeypatch.setattr(tokens, "timed", lambda entrants, threads: [Times((10.0,)), Times((5.0,))])
    for slower, ends in ((20.0, "are computed, and no chosen plan is faster by it"), (5.0, "are computed")):
        own = shutil.copytree(folder, tmp_path / f"{slower}")
        result = calibrate(own, files, learn=("loops", "tokens"), progress=False, max_distance=0.9)
        assert result.told["tokens"].endswith(ends)
        assert any(plan.tokens for plan in load_artifact(own).plans.values()) is (slower == 5.0)


def test_a_build_tries_no_setting_where_none_makes_a_call_faster(
    trials: Trials, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What takes up to a fifth longer counts as equally fast, and is nearer with all tokens."""
    told = "a call takes 10 ms with all tokens, and 9 with the fewest"
    monkeypatch.setattr(tokens, "timed", lambda entrants, threads: [Times((10.0,)), Times((9.0,))])
    monkeypatch.setattr(tokens, "judge", None)
    with pytest.raises(CalibrationFailedError, match=told):
        tried(trials, by_time=True)
    Tokens(request(by_time=True, deadline_ms=9.5))._require_faster(trials, trials.base, trials.base)  # a tenth may do


@pytest.mark.parametrize("slower", [False, True])
def test_a_calibration_says_that_a_call_becomes_slower(
    trials: Trials, monkeypatch: pytest.MonkeyPatch, slower: bool
) -> None:
    warned = list[str]()
    monkeypatch.setattr(tokens, "timed", lambda entrants, threads: [Times((6.2,)), Times((7.3 if slower else 5.0,))])
    monkeypatch.setattr(trials.bar, "warn", warned.append)
    assert tried(trials).plan.tokens is not None
    told = "a call takes 7.3 ms here if tokens are reused, and 6.2 if all are computed: these encoders are too small"
    assert [one.startswith(told) for one in warned] == [True] * slower


def test_where_time_runs_out_the_settings_that_were_tried_count(
    trials: Trials, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is tried at least; it has no tolerance and is rarely whole."""
    count = list[Plan]()

    def counted(trials: Trials, plan: Plan, part: str) -> Score:
        count.append(plan)
        return judge(trials, plan, part)

    monkeypatch.setattr(tokens, "judge", counted)
    (proposal,) = Tokens(request()).propose(trials, trials.base, Clock(0.0))
    assert [plan.tokens for plan in count] == [None, TokenReuse(0.0, 6)]
    assert proposal.plan.tokens == TokenReuse(0.0, 6)


def test_a_call_is_timed_after_another_picture(
    trials: Trials, found: Proposal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is timed with all tokens, since a robot may wait for such a call."""
    predict, counted = Runtime.predict, list[float]()

    def told(self: Runtime, obs: Any, noise: Any, plan: Plan) -> Any:
        made = predict(self, obs, noise, plan)
        if plan.tokens is not None:
            counted.append(made[1].frames.tokens / made[1].frames.of)
        return made

    monkeypatch.setattr(Runtime, "predict", told)
    timed([(trials, found.plan), (trials, replace(found.plan, tokens=None))], 1)
    assert len(counted) == WARM_UP + TIMED
    whole = counted.pop(WARM_UP)
    assert max(counted) < 0.5 < whole, "its first picture is whole, and the second of the window is not"


def test_a_plan_that_is_given_what_another_learned_is_judged_anew(folder: Path, files: list[Path]) -> None:
    artifact = load_artifact(folder)
    fields = {"distance": 9.0, "interval": [9.0, 9.0], "sparsity": 0.0, "flops_sparsity": 0.0}
    record = {"plans": {"other": fields}}
    update_plans(folder, {**artifact.plans, "other": replace(artifact.default, repair=True)}, FULL, record)
    result = calibrate(folder, files, learn=("tokens",), progress=False)
    after = load_artifact(folder)
    assert after.plans["other"].tokens is not None
    found = (after.manifest.calibration or {})["plans"]["other"]
    assert found["distance"] == result.plans["other"].distance == result.plans[FULL].distance
    assert found["tokens"] < 0.5 and found["distance"] < 1


def test_what_does_not_hold_on_other_episodes_is_told(
    folder: Path, files: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has the name of a plan that is kept, so that nothing else says that it was tried."""

    def no_better(kept: Kept, trials: Trials, score: Score, margin: float | None) -> str | None:
        return "is no better." if score.tokens < 1 else None

    monkeypatch.setattr(Kept, "_no_better", no_better)
    monkeypatch.setattr(tokens, "timed", lambda entrants, threads: [Times((10.0,)), Times((5.0,))])
    result = calibrate(folder, files, learn=("loops", "tokens"), max_distance=0.9)
    assert result.told["tokens"] == "" and result.skipped["tokens"] == "is no better."
    assert "'tokens' is left out: it is no better." in " ".join(capsys.readouterr().err.split())
    assert not any(plan.tokens for plan in load_artifact(folder).plans.values())


def test_what_is_learned_is_written(folder: Path, files: list[Path], tmp_path: Path) -> None:
    result = calibrate(folder, files, learn=("tokens",), progress=False)
    artifact = load_artifact(folder)
    plan = artifact.default
    assert result.default_plan == artifact.manifest.default_plan == FULL
    assert plan.tokens is not None and plan.tokens.refresh == 6
    assert artifact.plans[DENSE].tokens is None
    assert 5 / 37 <= result.plans[FULL].tokens < 0.5
    assert result.told["tokens"].startswith("on the calls that it was chosen on, ")
    assert result.told["tokens"].endswith("% of the tokens of new frames are computed")
    (rung,) = (rung for rung in verify(folder).rungs if rung.name == "tokens")
    assert rung.status == "passed"
    computed, of = rung.details["spot"]
    assert 0 < computed < of == 2 * 2 * 37, "of two streams, and two cameras"
    before = (folder / "manifest.json").read_bytes()
    shaking = recorded(tmp_path / "calls.npz", shaking=0.5)
    with pytest.raises(CalibrationFailedError, match=r"does not pay: it would compute \d+% of the tokens"):
        calibrate(folder, shaking, learn=("tokens",), progress=False)
    assert (folder / "manifest.json").read_bytes() == before


def test_what_does_not_pay_is_refused(trials: Trials) -> None:
    with pytest.raises(CalibrationFailedError, match="does not pay: the actions are .* further off at least, and -1"):
        tried(trials, margin=-1.0)


def test_what_computes_too_much_on_other_episodes_is_refused_there(trials: Trials, found: Proposal) -> None:
    score = judge(trials, found.plan, HELD_OUT)
    assert found.refusal(score, {}) is None
    assert "80% of the tokens" in str(found.refusal(replace(score, tokens=0.8), {}))
    assert found.refusal(replace(score, tokens=MOST_COMPUTED), {}) is None


def scripted(monkeypatch: pytest.MonkeyPatch, limits: dict[TokenReuse, tuple[float, float]]) -> None:
    """Each setting computes a share of the tokens, and is so much further off at most; others are far off."""

    def scored(trials: object, plan: Plan, part: str) -> Score:
        assert part == "learned"
        computed, limit = (1.0, 0.0) if plan.tokens is None else limits.get(plan.tokens, (0.0, 9.0))
        return Score(limit, (0, 0), None, None, 0, 0, 0, 1, tokens=computed)

    monkeypatch.setattr(tokens, "judge", scored)
    monkeypatch.setattr(tokens, "further", lambda one, _: (one.distance / 2, one.distance))
    monkeypatch.setattr(tokens, "THRESHOLDS", (0.0, 0.1, 0.2))


def test_the_fewest_tokens_within_the_upper_limit_are_taken(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    """A setting whose mean is within the margin, and whose limit over episodes is not, was lucky."""
    near, lucky = 0.9 * Tokens.margin, 1.9 * Tokens.margin
    limits = {TokenReuse(0.0, 6): (0.6, 0.0), TokenReuse(0.1, 6): (0.3, near), TokenReuse(0.2, 6): (0.1, lucky)}
    scripted(monkeypatch, {**limits, TokenReuse(0.0, 4): (0.5, 0.0)})
    assert tried(trials).plan.tokens == TokenReuse(0.1, 6)
    scripted(monkeypatch, {**limits, TokenReuse(0.0, 4): (0.29, 0.0)})
    assert tried(trials).plan.tokens == TokenReuse(0.0, 4)


def test_a_larger_threshold_than_one_that_is_far_off_is_not_tried(
    trials: Trials, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, {TokenReuse(0.0, 6): (0.6, 0.0), TokenReuse(0.2, 6): (0.1, 0.0)})
    assert tried(trials).plan.tokens == TokenReuse(0.0, 6)


def test_an_encoder_without_tokens_is_refused(once: Once) -> None:
    folder = once.folder("seeing", cameras.compile_seeing) / "artifact"
    told = Tokens(request()).applies(load_artifact(folder))
    assert "no image encoder of this policy is a vision transformer" in str(told)


def test_an_encoder_with_tokens_is_not(folder: Path) -> None:
    assert Tokens(request()).applies(load_artifact(folder)) is None
