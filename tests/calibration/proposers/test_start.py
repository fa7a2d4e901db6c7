"""From which step a call goes on with the chunk of the call before: chosen on recorded episodes."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import Score, judge
from ttscompile.calibration.kept import Kept, holding
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.proposers import start
from ttscompile.calibration.proposers.start import NAME, Start, candidates, warm_proposal
from ttscompile.calibration.trials import LEARNED, Trials
from ttscompile.core.lattice import Source, dense_plan, whole_steps_plan
from ttscompile.core.plan import FULL, Plan
from ttscompile.errors import CalibrationError, CalibrationFailedError
from ttscompile.measure.points import Gaps

from .trying import proposed, request, trials_of

pytestmark = pytest.mark.slow

STEPS, LOOP = 8, "ddim-8"


@pytest.fixture
def folder(one_layer_checkpoint: Path, once: Once, tmp_path: Path) -> Path:
    def convert(path: Path) -> None:
        ttscompile.convert(one_layer_checkpoint, path, sampler="ddim", steps=STEPS)

    return Path(shutil.copytree(once.folder("warm start", convert), tmp_path / "artifact"))


def recorded(path: Path, episodes: int = 3, calls: int = 4) -> list[Path]:
    rng = np.random.default_rng(0)
    ends = calls * np.arange(1, episodes + 1)
    np.savez(path, obs=rng.uniform(100, 400, (ends[-1], 2, 20)).astype(np.float32), episode_ends=ends)
    return [path]


@pytest.fixture
def trials(folder: Path, tmp_path: Path) -> Trials:
    return trials_of(folder, recorded(tmp_path / "calls.npz"))


def scheduled(trials: Trials, *steps: int) -> Plan:
    blocks = len(trials.artifact.manifest.blocks)
    return replace(trials.base, cells=whole_steps_plan(STEPS, blocks, (0, *steps)))


def first(proposer: Start, trials: Trials, plan: Plan) -> Proposal:
    """What is proposed first; it is kept."""
    proposals = proposer.propose(trials, plan, Clock())
    found = next(proposals)
    with pytest.raises(StopIteration):
        proposals.send(True)
    return found


def described(proposal: Proposal) -> tuple[int, list[int]]:
    """How many steps there are, and which are computed."""
    cells = proposal.plan.cells
    assert cells is not None
    return len(cells), np.flatnonzero((cells == Source.COMPUTE).all(axis=1)).tolist()


def test_candidates_are_dense_rests_and_those_of_the_schedule_by_what_they_compute(trials: Trials) -> None:
    """By hand: of the steps 0, 4 and 6 of 8 the last 2, 3 and 5 have 6, and of half of the loop all is tried."""
    dense = [(1, [0]), (2, [0, 1]), (3, [0, 1, 2])]
    assert [described(one) for one in candidates(trials.artifact, trials.base)] == dense
    found = [described(one) for one in candidates(trials.artifact, scheduled(trials, 4, 6))]
    assert found == [(1, [0]), (2, [0]), (2, [0, 1]), (3, [0, 1]), (3, [0, 1, 2])]
    assert candidates(trials.artifact, replace(trials.base, cells=None))[0].plan.cells is not None, "of a pruner's plan"


def test_a_candidate_falls_back_on_the_plan_that_it_was_made_of(trials: Trials) -> None:
    plan = replace(scheduled(trials, 4), precision={"blocks": "int8"})
    for one in candidates(trials.artifact, plan):
        steps = described(one)[0]
        assert one.plan.otherwise is plan and one.plan.correction is None
        assert (one.plan.loop, one.plan.precision) == (f"{LOOP}-last-{steps}", plan.precision)
        assert one.starts == {one.plan.loop: StartRecord(LOOP, steps)}


def test_the_fewest_cells_within_the_margin_are_taken(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {(1, 1): 1.5, (2, 1): 1.4, (2, 2): 1.3, (3, 2): 1.2, (3, 3): 1.0}

    def scored(_: Trials, plan: Plan, part: str) -> Score:
        assert part == "learned" and plan.cells is not None
        computed = int((plan.cells == Source.COMPUTE).all(axis=1).sum())
        limit = limits[len(plan.cells), computed] if plan.otherwise is not None else 0.0
        return Score(limit, (0, 0), None, None, 0, 0, 0, 1)

    monkeypatch.setattr(start, "judge", scored)
    monkeypatch.setattr(start, "further", lambda one, _: (one.distance / 2, one.distance))
    plan = scheduled(trials, 4, 6)
    for margin, expected in ((1.45, (2, [0])), (1.35, (2, [0, 1])), (1.1, (3, [0, 1, 2]))):
        found = first(Start(request(margin=margin)), trials, plan)
        assert described(found) == expected
        assert (found.name, found.margin, found.notes["steps"]) == (NAME, margin, expected[0])
    refused = Start(request(margin=1.25))
    assert [described(one) for one in proposed(refused, trials, plan)] == [(3, [0, 1]), (3, [0, 1, 2])]
    assert refused.told == "", "no call begins so"
    with pytest.raises(CalibrationFailedError, match="the last 3 steps are 1 further off at worst, and 0.9 is allowed"):
        proposed(Start(request(margin=0.9)), trials, plan)


def test_a_later_start_keeps_more_of_the_chunk(trials: Trials) -> None:
    few, many = (warm_proposal(trials.base, n, dense_plan(n, len(trials.artifact.manifest.blocks))) for n in (1, 4))
    scores = [judge(holding(trials, one), one.plan, LEARNED) for one in (few, many)]
    assert scores[0].distance > max(scores[1].distance, 0.1)


def test_a_plan_that_begins_so_already_is_made_anew(trials: Trials) -> None:
    warm = warm_proposal(trials.base, 3, dense_plan(3, len(trials.artifact.manifest.blocks)))
    found = first(Start(request(margin=1e6)), holding(trials, warm), warm.plan)
    assert found.plan.otherwise is trials.base
    assert described(found) == (1, [0])


def test_what_is_learned_is_written_and_loaded(folder: Path, tmp_path: Path) -> None:
    files = recorded(tmp_path / "calls.npz")
    result = calibrate(folder, files, learn=("start",), max_distance=1e6, progress=False)
    artifact = load_artifact(folder)
    assert result.default_plan == artifact.manifest.default_plan == NAME
    assert artifact.manifest.starts == {f"{LOOP}-last-1": StartRecord(LOOP, 1)}
    assert artifact.plans[NAME].otherwise is artifact.plans[FULL]
    assert "in the last 1 steps" in result.told["start"]
    policy = ttscompile.load(folder)
    policy.reset()
    obs = np.random.default_rng(1).uniform(100, 400, (1, 2, 20)).astype(np.float32)
    loops = []
    for _ in range(2):
        policy.predict_action({"obs": obs})
        assert policy.last_report is not None
        loops.append(policy.last_report.loop)
    assert loops == [LOOP, f"{LOOP}-last-1"]


@pytest.mark.parametrize(
    ("distance", "asked", "default"), [(0.2, {}, NAME), (0.9, {}, FULL), (0.9, {"farthest": 1.0}, NAME)]
)
def test_a_plan_with_which_scores_may_fall_is_kept_and_is_no_default(
    trials: Trials, monkeypatch: pytest.MonkeyPatch, distance: float, asked: dict[str, float], default: str
) -> None:
    def scored(_: Trials, plan: Plan, part: str = "held out") -> Score:
        far, calls = distance if plan.otherwise is not None else 0.0, np.arange(4)
        return Score(far, (far, far), None, None, 0, 0, 0, 1, gaps=Gaps(np.full(4, far**2), calls))

    warned: list[str] = []
    monkeypatch.setattr("ttscompile.calibration.kept.judge", scored)
    monkeypatch.setattr(trials.bar, "warn", warned.append)
    kept, found = Kept(trials, False, **asked), candidates(trials.artifact, trials.base)[0]
    assert kept.default == FULL
    assert kept.consider(replace(found, margin=1.2)) is None
    assert kept.learned and NAME in kept.plans and kept.default == default
    told = ["plan 'warm' is kept, and 'full' stays the default: 'warm' is 0.90 of what other noise changes"]
    assert [one.partition(" from ")[0] for one in warned] == told * (default == FULL)


def test_what_is_far_off_changes_nothing(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start.Start, "margin", -9.0)
    before = (folder / "manifest.json").read_bytes()
    with pytest.raises(CalibrationFailedError, match="is allowed"):
        calibrate(folder, recorded(tmp_path / "calls.npz"), learn=("start",), progress=False)
    assert (folder / "manifest.json").read_bytes() == before


def test_too_little_is_refused(folder: Path, tmp_path: Path) -> None:
    trials = trials_of(folder, recorded(tmp_path / "calls.npz", 3, 1))
    with pytest.raises(CalibrationError, match="judged on episodes of two calls at least"):
        proposed(Start(request()), trials, trials.base)


def test_a_loop_of_two_steps_has_half(one_layer_checkpoint: Path, tmp_path: Path) -> None:
    ttscompile.convert(one_layer_checkpoint, tmp_path / "two", sampler="ddim", steps=2)
    artifact = load_artifact(tmp_path / "two")
    assert Start(request()).applies(artifact) is None
    assert [described(one) for one in candidates(artifact, artifact.default)] == [(1, [0])]


def test_a_loop_of_one_step_and_one_whose_table_does_not_tell_are_refused(
    compiled: Path, one_layer_checkpoint: Path, tmp_path: Path
) -> None:
    assert "'toy' does not tell what part of its sample is noise" in str(
        Start(request()).applies(load_artifact(compiled))
    )
    ttscompile.convert(one_layer_checkpoint, tmp_path / "one", sampler="ddim", steps=1)
    assert Start(request()).applies(load_artifact(tmp_path / "one")) == "a loop of 1 step has no half"
