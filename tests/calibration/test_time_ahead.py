"""A build ends near the minutes that it was given: what follows the search is in them, by what it has taken so far."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import choose as choosing, judge as judging, pipeline
from ttscompile.calibration.choose import choose, seconds_to_judge_others, seconds_to_time
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import TIMED, WARM_UP, Score, judge, seconds_to_judge
from ttscompile.calibration.kept import Kept
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.proposer import Proposal, Proposer
from ttscompile.calibration.proposers import rows_of
from ttscompile.calibration.state import FILE as STATE
from ttscompile.calibration.trials import CONFIRMING, HELD_OUT, LEARNED, Trials
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import DENSE, Plan
from ttscompile.errors import CalibrationFailedError
from ttscompile.measure.timer import Times

from .proposers.trying import request, trials_of

INT8 = {"blocks": "int8"}


class Hand(Clock):
    """A clock that is moved by hand."""

    def __init__(self, limit: float) -> None:
        super().__init__(limit)
        self.now = [0.0]  # shared by all that are made of it

    def elapsed(self) -> float:
        return self.now[0]


@pytest.fixture
def trials(artifact: Path, recording: Path) -> Trials:
    """Of a policy of ten steps; a call takes 2 ms with one computed step, and 3 ms more with each other one."""
    found = replace(trials_of(artifact, [recording]), clock=Hand(100.0))
    found.state.progress["costs"] = {"original": [2.0, 3.0]}
    return found


def plan_of(*steps: int, **fields: Any) -> Plan:
    return Plan(cells=whole_steps_plan(10, 6, steps), repair=True, **fields)


def score_of(distance: float) -> Score:
    return Score(distance, (0.0, distance), None, None, 0.0, 0.0, 0.0, 1)


def calls(trials: Trials, part: str = "held out") -> int:
    sample = trials.sample(part)
    return len(sample.calls) * sample.draws


def test_a_judgement_is_expected_to_take_what_others_of_its_kind_took(
    trials: Trials, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In proportion to what their calls take alone."""
    clock, made = cast(Hand, trials.clock), judging._Answers.all
    assert seconds_to_judge(trials, plan_of(0, 5)) == pytest.approx(calls(trials) * 0.005)

    def slow(self: Any) -> Iterator[Any]:
        clock.now[0] += calls(trials) * 0.005 * 3
        yield from made(self)

    monkeypatch.setattr(judging._Answers, "all", slow)
    judge(trials, plan_of(0, 5))
    assert seconds_to_judge(trials, plan_of(0, 5)) == pytest.approx(calls(trials) * 0.005 * 3)
    assert seconds_to_judge(trials, plan_of(0, 4, 7, 8)) == pytest.approx(calls(trials) * 0.011 * 3)
    assert seconds_to_judge(trials, plan_of(0, 5), lowered=True) == pytest.approx(calls(trials) * 0.005), "none yet"


def test_time_is_left_for_eight_bits_and_for_timing_all(trials: Trials) -> None:
    """Parts are tried on the calls that are chosen on, on the slowest plan; all plans are judged in eight bits."""
    record: Any = type("Record", (), {"kept": ("blocks", "condition")})()
    manifest = replace(trials.artifact.manifest, precision=record)
    kept = Kept(replace(trials, artifact=replace(trials.artifact, manifest=manifest)), anew=True)
    kept.plans |= {"two": plan_of(0, 5), "three": plan_of(0, 5, 8)}
    rounds, dense, tried = WARM_UP + TIMED, 0.029, 3 * calls(trials, LEARNED) * 0.008
    assert seconds_to_judge_others(kept, lowers=True) == pytest.approx(calls(trials) * 0.013 + tried)
    assert seconds_to_judge_others(kept, lowers=False) == pytest.approx(calls(trials) * 0.013)
    confirming = calls(trials, CONFIRMING) * (dense + 0.013)  # of three plans at most, those that take longest
    assert seconds_to_time(kept, None) == pytest.approx(2 * rounds * (dense + 0.013) + confirming)
    # By a deadline two plans are called 200 times. The machine may be slower than it was.
    trials.clock.paces[True] = 3.0
    assert seconds_to_time(kept, 50.0) == pytest.approx(3 * 2 * rounds * (dense + 0.013) + 2 * 200 * 0.05 + confirming)
    kept.judged, kept.scores = dict(kept.plans), dict.fromkeys(kept.plans, score_of(0.1))
    assert seconds_to_judge_others(kept, lowers=False) == 0


def test_nothing_is_judged_twice(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither what was judged before it got eight bits, nor the original, which is 0 away from itself."""
    asked, confirmed, kept = list[Plan](), list[Plan](), Kept(trials, anew=True)

    def judged(_: Trials, plan: Plan, part: str = HELD_OUT) -> Score:
        (confirmed if part == CONFIRMING else asked).append(plan)
        return score_of(0.05 if plan.precision else 0.04)

    monkeypatch.setattr(choosing, "judge", judged)
    monkeypatch.setattr("ttscompile.calibration.kept.judge", judged)
    monkeypatch.setattr(choosing, "timed", lambda entrants, *_: [Times((1.0 + n,)) for n in range(len(entrants))])
    monkeypatch.setattr(choosing, "weights_read", lambda *_: 0)
    first, other = plan_of(0, 5), plan_of(0, 4, 8)
    for plan, name in ((first, "two"), (other, "three")):
        kept.consider(Proposal(name, plan, beside=True))
    kept.consider(Proposal("two", first, margin=float("inf")))
    assert asked == [first, other]
    kept.consider(Proposal("two", replace(first, precision=INT8), margin=float("inf"), shared={"precision": INT8}))
    frontier = choose(kept, request(bound=0.1))
    assert [(plan.cells is other.cells, bool(plan.precision)) for plan in asked[2:]] == [(False, True), (True, True)]
    assert confirmed == [frontier.plans[name] for name in ("schedule",)]
    distances = {row["name"]: row["distance"] for row in frontier.tried}
    assert distances[DENSE] == 0 and sorted(distances.values()) == [0, 0.04, 0.04, 0.05, 0.05]
    assert kept.known("three", replace(other, correction=None, cells=first.cells)) is None, "another plan"


def test_what_there_is_no_time_to_judge_is_left_out_by_name(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    """The best plan was judged; others are chosen as they were before they got eight bits."""
    kept = Kept(trials, anew=True)
    best, other = plan_of(0, 5, precision=INT8), plan_of(0, 4, 8)
    kept.plans |= {"two": best, "three": replace(other, precision=INT8)}
    kept.judged, kept.scores, kept.exact = {"two": best}, {"two": score_of(0.09)}, {"three": (other, score_of(0.01))}
    monkeypatch.setattr(choosing, "judge", lambda *_: pytest.fail("there is no time"))
    monkeypatch.setattr(choosing, "timed", lambda entrants, *_: [Times((9.0 - n,)) for n in range(len(entrants))])
    monkeypatch.setattr(choosing, "weights_read", lambda *_: 0)
    cast(Hand, trials.clock).now[0] = 101.0
    frontier = choose(kept, request(bound=0.1))
    assert {row["name"] for row in frontier.tried} == {DENSE, "schedule", "two"}
    assert frontier.plans["schedule"].cells is other.cells and not frontier.plans["schedule"].precision
    left = ["2 of 10 steps of original", "3 of 10 steps of original, int8 in blocks", "confirming 'three'"]
    assert trials.clock.left_out == left and not any("confirmed" in row for row in frontier.tried)


class Silent(Proposer):
    """Proposes nothing."""

    heard = False

    def propose(self, *_: object) -> Iterator[Proposal]:  # type: ignore[override]
        self.heard = True
        yield from ()


@pytest.mark.parametrize(("now", "heard"), [(10.0, True), (99.9, False)])
def test_what_could_not_be_judged_in_time_is_not_begun(trials: Trials, now: float, heard: bool) -> None:
    kept, two = Kept(trials, anew=True), [Silent(request()) for _ in range(2)]
    kept.learned, cast(Hand, trials.clock).now[0] = True, now
    trials.clock.ahead.append(lambda: 1e3)  # judging other plans, which need not be
    pipeline._hear(kept, rows_of(("loops", "precision")), two, trials.clock, request(by_time=True))
    assert [one.heard for one in two] == [True, heard]
    assert (kept.refused == {"precision": "was not tried: there was no time for it"}) != heard
    assert trials.clock.left_out == ["precision"] * (not heard)


@pytest.mark.slow
def test_a_build_that_has_no_time_ends_with_the_original_and_says_what_it_left_out(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warned = list[str]()
    monkeypatch.setattr(Bar, "warn", lambda self, what: warned.append(what))
    how: dict[str, Any] = {"learn": ("loops",), "max_minutes": 1e-6, "max_distance": 1e-9, "progress": False}
    result = calibrate(artifact, [recording], **how)
    assert (result.default_plan, result.stopped, set(result.plans)) == (DENSE, "time limit", {DENSE})
    assert load_artifact(artifact).manifest.default_plan == DENSE
    assert ttscompile.load(artifact).predict_action({"obs": np.zeros((1, 2, 3), np.float32)})["action"].shape == (
        1,
        4,
        2,
    )
    assert any("Time was too short, so the original is all that there is." in one for one in warned)
    assert any("Left out or cut short: original, " in one for one in warned)
    # More time, or a larger error, goes on with the answers that it has.
    assert (artifact / STATE).is_file()
    answers = list[str]()
    monkeypatch.setattr(Bar, "stage", lambda self, what, *_: answers.append(what))
    further = calibrate(artifact, [recording], **how | {"max_minutes": 0.1, "max_distance": 3.0}, resume=True)
    assert further.default_plan == "schedule" and not (artifact / STATE).exists()
    assert not any("original, held out" in one for one in answers)
    with pytest.raises(CalibrationFailedError, match="no plan"):  # which the original need not keep
        calibrate(artifact, [recording], **how, latency_ms=1e3)
