"""Which loop, and how few of its steps."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.calibration.killed import killed
from tests.families import cameras
from tests.once import Once
from ttscompile import PolicySpec, SamplerTable
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.arguments import CallLimits
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import Score, judge
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.proposer import SAFER, Proposal, near
from ttscompile.calibration.proposers import loops
from ttscompile.calibration.proposers.loops import REACH, Cost, Loops, would_help
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.task import Task
from ttscompile.calibration.trials import Trials
from ttscompile.core.plan import DENSE, ORIGINAL
from ttscompile.core.tokenizer import Instruction
from ttscompile.errors import CalibrationError, CalibrationFailedError
from ttscompile.measure.machine import timed_on
from ttscompile.measure.timer import Times
from ttscompile.pool import Pool
from ttscompile.report import Extras, build
from ttscompile.report.facts import chosen as chosen_of

from .trying import request, trials_of

COSTS = {ORIGINAL: (10.0, 1.0), "short": (4.0, 1.0), "wrong": (3.0, 1.0)}
"""Milliseconds of a call with one computed step, and more for each further one."""


def table(steps: int, towards: float) -> SamplerTable:
    """Fewer steps of the policy's own form, each of which goes further to the prediction times ``towards``."""
    columns = {name: np.zeros(steps, np.float32) for name in SamplerTable.COLUMNS}
    share = 1 - 0.75 ** (policies.STEPS / steps)
    columns["x0_to_next"] += towards * share
    columns["sample_to_next"] += 1 - share
    columns["out_to_x0"] += 1
    columns["noise_to_next"][:-1] += 0.05
    return SamplerTable("toy", np.linspace(9, 0, steps).round().astype(np.int64), clip=1.0, **columns)


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    """A policy of ten steps with a loop of eight that does nearly the same, and one that does something else."""
    spec = replace(policies.spec(), loops={"short": table(8, 1.0), "wrong": table(8, -1.0)})
    module = policies.Mixer(0).eval()
    return once.compiled("mixer of three loops", lambda path: ttscompile.compile_denoiser(module, spec, path))[0]


@pytest.fixture
def directory(compiled: Path, tmp_path: Path) -> Path:
    return shutil.copytree(compiled, tmp_path / "compiled")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return policies.record(tmp_path / "calls.npz", 8)


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops cost what ``COSTS`` says."""
    monkeypatch.setattr(Loops, "_measured", lambda self, trials, loop: COSTS[loop])


def proposed(proposer: Loops, trials: Trials) -> dict[str, tuple[Proposal, Score]]:
    """All that is proposed, judged as a calibration judges it; those that are refused are left out."""
    found: dict[str, tuple[Proposal, Score]] = {}
    proposals, held = proposer.propose(trials, trials.base, trials.clock), None
    with suppress(StopIteration):
        while True:
            one = next(proposals) if held is None else proposals.send(held)
            score = judge(trials, one.plan)
            held = one.refusal(score, {name: before for name, (_, before) in found.items()}) is None
            if held:
                found.pop(one.name, None)
                found[one.name] = one, score
    return found


def test_a_cost_is_that_of_a_step_and_of_each_further_one() -> None:
    assert [Cost(3.0, 0.5).of(steps) for steps in (1, 2, 5)] == [3.0, 3.5, 5.0]


@pytest.mark.slow
def test_loops_are_tried_and_the_fastest_that_is_near_enough_is_proposed_last(
    directory: Path, recording: Path, timed: None
) -> None:
    trials = trials_of(directory, [recording])
    proposer = Loops(request(bound=0.4))
    found = proposed(proposer, trials)
    own = {loop: [name for name, (one, _) in found.items() if one.plan.loop == loop] for loop in COSTS}
    assert not own["wrong"], "with every step computed it is somewhere else"
    assert "wrong is" in proposer.told and "with every step computed" in proposer.told
    last, score = list(found.values())[-1]
    assert not last.beside and last.plan.loop == "short" and near(score.distance, score.interval, 0.4)
    assert len(own["short"]) == 2, "the one that is near enough, and one of more steps for what follows"
    # It uses more than half of the bound; so the original, slow as it is, is searched for one that is clearly nearer.
    by_steps = sorted(own[ORIGINAL], key=lambda name: int(name.partition(".")[2]))
    safer = [found[name][1].distance <= SAFER * score.distance for name in by_steps]
    assert safer and safer[-1] and not any(safer[:-1])


def test_a_loop_that_may_only_give_fast_comes_last_and_gets_less_of_the_time(
    directory: Path, recording: Path, timed: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[tuple[str, float, float]] = []

    def of_loop(_: Loops, own: Trials, loop: str, clock: Clock, cost: Cost, wanted: float) -> Iterator[Proposal]:
        tried.append((loop, wanted, clock.limit))
        return iter(())

    monkeypatch.setattr(Loops, "_of_loop", of_loop)
    monkeypatch.setattr(Clock, "elapsed", lambda self: 0.0)
    trials = replace(trials_of(directory, [recording]), clock=Clock(100.0))
    for bound in (0.4, 0.01):
        with pytest.raises(CalibrationFailedError, match="no plan could be tried: wrong is"):
            proposed(Loops(request(bound=bound, farthest=0.4)), trials)
    close, far = tried[:2], tried[2:]
    assert close == [("short", 0.4, 50.0), (ORIGINAL, 0.4, 100.0)]
    assert far == [(ORIGINAL, 0.01, 80.0), ("short", 0.4, 100.0)]


def test_a_plan_that_was_placed_by_rule_stays_where_a_search_finds_no_nearer_one() -> None:
    loops, near_one, far_one = Loops(request(bound=0.4)), score_of(0.1), score_of(0.2)
    assert loops._refusal("short.2", near_one, {}) is None
    assert loops._refusal("short.2", far_one, {"short.2": near_one}) == (
        "is 0.2 from the original; another of as many steps 0.1"
    )
    assert loops._scores["short.2"] is near_one
    assert loops._refusal("short.2", score_of(0.05), {"short.2": near_one}) is None


@pytest.mark.slow
def test_a_small_network_is_searched_with_more_calls_than_its_rules_were_tried_on(
    directory: Path, recording: Path, timed: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned, of = list[tuple[int, bool]](), Task.of

    def told(runner: Runner, calls: Calls, budget: int, seed: int, pool: Pool, small: bool = False) -> Task:
        learned.append((calls.count, small))
        return of(runner, calls, budget, seed, pool, small=small)

    monkeypatch.setattr(loops, "calls_to_learn_from", lambda *_, corrects: CallLimits(8, 16, 16))
    monkeypatch.setattr(loops, "MOST_NEEDED", 16)
    monkeypatch.setattr(loops, "MOST_CALLS", 40)
    monkeypatch.setattr(Task, "of", told)
    found = proposed(Loops(request(bound=3.0)), trials_of(directory, [recording]))
    assert learned == [(16, False), (40, True)] * max(1, len(learned) // 2)
    assert near(found[next(reversed(found))][1].distance, (0.0, 0.0), 3.0)


def test_what_is_far_beyond_reach_is_not_searched() -> None:
    proposer = Loops(request(bound=0.1))
    proposer._scores = {"short.1": score_of(REACH * 0.1 + 0.01), "short.2": score_of(REACH * 0.1)}
    assert proposer._within_reach("short", [1, 2, 3], 0.1) == [2, 3], "3 was refused, or not tried"
    assert proposer._within_reach("short", [1], 0.1) == [1], "the nearest that there is"


def score_of(distance: float) -> Score:
    return Score(distance, (distance, distance), None, None, 0.0, 0.0, 0.0, 1)


@pytest.mark.slow
def test_a_slow_original_is_left_out_where_the_fastest_plan_is_near(
    directory: Path, recording: Path, timed: None
) -> None:
    proposer = Loops(request(bound=3.0))
    found = proposed(proposer, trials_of(directory, [recording]))
    last, score = list(found.values())[-1]
    assert score.distance < 1.5 and not any(one.plan.loop == ORIGINAL for one, _ in found.values())
    assert f"original takes 10 ms at least, and the best {COSTS[last.plan.loop][0]:g}" in proposer.told


@pytest.mark.slow
def test_where_no_plan_is_near_enough_the_nearest_is_told(directory: Path, recording: Path, timed: None) -> None:
    with pytest.raises(CalibrationFailedError, match=r"the nearest, '\w+\.\d', is .* 0.0001 and 0.000125 are allowed"):
        proposed(Loops(request(bound=1e-4)), trials_of(directory, [recording]))


@pytest.mark.slow
def test_what_was_found_before_the_time_was_over_is_found_again(directory: Path, recording: Path, timed: None) -> None:
    """As where the last seconds of a build are interrupted, or nothing was near enough and it is asked again."""
    trials = trials_of(directory, [recording])
    found = proposed(Loops(request(bound=0.4)), trials)
    over = replace(trials, clock=Clock(1.0, before=2.0))
    assert {*proposed(Loops(request(bound=0.4)), over)} == {*found}
    assert len(found) > 3 and over.clock.left() < 0


@pytest.mark.slow
def test_with_a_deadline_more_steps_are_tried_than_have_to_be(directory: Path, recording: Path, timed: None) -> None:
    trials = trials_of(directory, [recording])
    steps = {}
    for deadline in (4.5, 7.5):
        found = proposed(Loops(request(bound=0.4, deadline_ms=deadline)), trials)
        steps[deadline] = sorted({int(name.partition(".")[2]) for name in found})
        assert {one.plan.loop for one, _ in found.values()} == {"short"}, "the original takes 10 ms"
    assert max(steps[4.5]) == 1 and max(steps[7.5]) == 4


@pytest.mark.slow
def test_a_calibration_of_loops_keeps_what_it_chooses(directory: Path, recording: Path, timed: None) -> None:
    before = load_artifact(directory).manifest.model_identity
    result = calibrate(directory, [recording], learn=("loops",), max_distance=0.4, progress=False, max_minutes=2)
    artifact = load_artifact(directory)
    assert artifact.manifest.model_identity == before
    assert artifact.manifest.default_plan == result.default_plan == "schedule"
    assert result.budget == {"max_distance": 0.4} and not result.doubtful, "it was said how far it may be"
    assert set(artifact.plans) == {DENSE, *result.plans} and "schedule" in result.plans
    rows = {row["name"]: row for row in artifact.manifest.calibration["frontier"]}  # type: ignore[index]
    assert rows[DENSE]["distance"] < 1e-5 and rows["schedule"]["near"] and rows["schedule"]["kept"]
    assert rows["schedule"]["interval"][1] <= 0.8 and rows["schedule"]["distance"] <= 0.4
    assert all(row["kept"] == (name in artifact.plans) for name, row in rows.items())
    (told,) = chosen_of(artifact.manifest.calibration or {})
    assert told.startswith(f"Chosen among {len(rows)} plans: {rows['schedule']['told']}: ")
    assert chosen_of({}) == ()
    policy = ttscompile.load(directory)
    assert policy.info.timed_on == f"timed on {timed_on(1)}" == f"timed on {result.timed_on}"
    assert policy.predict_action({"obs": np.zeros((1, 2, 3), np.float32)})["action"].shape == (1, 4, 2)
    page = build(artifact, policy, Extras(calls=1))
    assert told in page.lead
    first = page.sections[0]
    assert len(first.pictures) == 1 and "The plans that the build chose among" in first.text[0]
    (table,) = first.tables
    assert {row[1]: row[2] for row in table.rows} == {
        name: "0" if name == DENSE else f"{max(row['distance'], 0):.4g}" for name, row in rows.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("most", [4, pytest.param(20, marks=pytest.mark.soak)])
def test_killed_at_random_moments_and_resumed_it_ends_the_same(
    directory: Path, recording: Path, timed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """One calibration that is killed again and again, each time after some further saves of its state."""
    milliseconds = {loop: Times((one,)) for loop, (one, _) in COSTS.items()}
    monkeypatch.setattr(Clock, "elapsed", lambda self: 0.0)
    monkeypatch.setattr(
        "ttscompile.calibration.choose.timed", lambda entrants, *_: [milliseconds[p.loop] for _, p in entrants]
    )
    own = shutil.copytree(directory, tmp_path / "own")
    how: dict[str, Any] = {"learn": ("loops",), "max_distance": 0.4, "progress": False}
    calibrate(own, [recording], **how)
    draw = np.random.default_rng(0)
    kills = 0
    while kills < most:
        try:
            with killed(int(draw.integers(1, 8 if most < 20 else 4))):
                calibrate(directory, [recording], resume=kills > 0, **how)
        except pytest.fail.Exception:  # it came to its end
            break
        kills += 1
    else:
        calibrate(directory, [recording], resume=True, **how)
    assert kills == most
    assert {p.name: p.read_bytes() for p in directory.iterdir()} == {p.name: p.read_bytes() for p in own.iterdir()}


def test_where_no_loop_keeps_the_deadline_it_is_told_how_far_and_what_may_help(
    directory: Path, recording: Path, timed: None
) -> None:
    """More time would not."""
    told = "no plan keeps 2 ms: one computed step of 'short', .*, takes 4 ms, 2 times as long. What may help: more"
    with pytest.raises(CalibrationFailedError, match=told):
        proposed(Loops(request(bound=0.4, deadline_ms=2.0)), trials_of(directory, [recording]))


def test_what_may_help_is_what_the_policy_has() -> None:
    def told(spec: PolicySpec, within: float | None = None) -> str:
        trials: Any = SimpleNamespace(artifact=SimpleNamespace(manifest=SimpleNamespace(spec=spec)))
        return would_help(trials, request(threads=2), within)

    one = "What may help: more than 2 threads (--threads), a larger --error, or a slower loop."
    assert told(policies.spec()) == one
    assert told(policies.spec(), 0.2272) == one.replace("a larger --error", "--error 0.23")
    told_so = Instruction("tokens", "mask", new_line=False)
    seeing = replace(cameras.policy("shared", told=True)[1], instruction=told_so)
    more = "(--threads), a camera less (--without-camera), one instruction compiled in (--task), a larger"
    assert told(seeing) == one.replace("(--threads), a larger", more)


def test_what_was_timed_with_other_threads_is_not_gone_on_with(directory: Path, recording: Path, timed: None) -> None:
    how: dict[str, Any] = {"learn": ("loops",), "max_distance": 0.4, "progress": False}
    with killed():
        calibrate(directory, [recording], **how)
    with pytest.raises(CalibrationError, match="other settings: threads was 1, now 2"):
        calibrate(directory, [recording], threads=2, resume=True, **how)


def test_one_call_to_judge_on_is_refused_before_anything_is_searched(directory: Path, tmp_path: Path) -> None:
    """Of two episodes of one call; no distance would have a limit, however long the search."""
    recording = tmp_path / "short.npz"
    np.savez(recording, obs=np.eye(2, 6, dtype=np.float32).reshape(2, 2, 3), episode_ends=[1, 2])
    told = "leave one call to judge plans on, .* expected two at least. Record more"
    with pytest.raises(CalibrationError, match=told):
        calibrate(directory, [recording], learn=("loops",), progress=False)


def test_what_loops_cannot_keep_is_refused(directory: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match="makes the first plan; found 'schedule' and 'loops'"):
        calibrate(directory, [recording], learn=("schedule", "loops"), progress=False)
    with pytest.raises(CalibrationError, match="found a budget in cells"):
        calibrate(directory, [recording], 0.8, learn=("loops",), progress=False)
