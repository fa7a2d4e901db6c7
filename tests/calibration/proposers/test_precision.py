"""Which parts compute in eight bits: all but those that change the actions too much."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from tests.runtimes import seeing
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.judge import Score, further, judge
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.proposers import precision
from ttscompile.calibration.proposers.precision import Precision
from ttscompile.calibration.trials import LEARNED, Trials
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import FULL, Plan

from .trying import proposed, request, trials_of

LOUD = 1000.0
"""A channel of the encoder that takes all of the eight bits."""


def recorded(path: Path) -> list[Path]:
    """Four episodes of five calls of the policy that sees."""
    images = np.random.default_rng(0).standard_normal((20, 3, 16, 16), dtype=np.float32)
    np.savez(path, image=images, episode_ends=[5, 10, 15, 20])
    return [path]


@pytest.fixture
def trials(once: Once, tmp_path: Path) -> Trials:
    """Of a policy whose encoder and blocks are in eight bits."""
    folder = shutil.copytree(seeing.compiled(once)[0], tmp_path / "int8")
    return trials_of(Path(folder), recorded(tmp_path / "calls.npz"))


def scripted(monkeypatch: pytest.MonkeyPatch, limits: Mapping[tuple[str, ...], float]) -> None:
    """How much further off plans are at most, by the parts that are in eight bits; half of that on average."""

    def scored(_: Trials, plan: Plan, part: str) -> Score:
        assert part == "learned"
        return Score(limits[tuple(plan.precision)], (0, 0), None, None, 0, 0, 0, 1)

    monkeypatch.setattr(precision, "judge", scored)
    monkeypatch.setattr(precision, "further", lambda one, _: (one.distance / 2, one.distance))


@pytest.mark.slow
def test_all_parts_are_in_eight_bits_where_that_changes_little(trials: Trials) -> None:
    proposer = Precision(request())
    (found,) = proposed(proposer, trials, trials.base)
    assert dict(found.plan.precision) == {"condition": "int8", "blocks": "int8"}
    assert (found.name, found.margin, found.shared) == (FULL, Precision.margin, {"precision": found.plan.precision})
    exact = judge(trials, trials.base.exact, LEARNED)
    assert further(judge(trials, found.plan, LEARNED), exact)[1] <= Precision.margin
    assert proposer.told == "int8 in condition and blocks"


@pytest.mark.slow
def test_what_changes_the_actions_much_stays_fp32(tmp_path: Path) -> None:
    ttscompile.compile_denoiser(*seeing.policy(LOUD), tmp_path / "loud", precision="int8")
    trials, proposer = trials_of(tmp_path / "loud", recorded(tmp_path / "calls.npz")), Precision(request())
    (found,) = proposed(proposer, trials, trials.base)
    assert dict(found.plan.precision) == {"blocks": "int8"}
    alone = found.notes["alone"]
    assert alone["blocks"] < Precision.margin < alone["condition"]
    assert proposer.told.startswith("int8 in blocks; condition stays fp32")


@pytest.mark.slow
def test_what_is_learned_is_written_for_all_plans(tmp_path: Path) -> None:
    ttscompile.compile_denoiser(*seeing.policy(LOUD), tmp_path / "loud", precision="int8")
    calibrate(tmp_path / "loud", recorded(tmp_path / "calls.npz"), learn=("precision",), progress=False)
    plans = load_artifact(tmp_path / "loud").plans
    assert {name: dict(plan.precision) for name, plan in plans.items()} == {"dense": {}, "full": {"blocks": "int8"}}


@pytest.mark.slow
def test_four_bits_are_judged_as_eight_are(trials: Trials, tmp_path: Path) -> None:
    """The same network in four bits is further off, stays where a margin allows it, and is what a plan then names."""
    ttscompile.compile_denoiser(*seeing.policy(), tmp_path / "int4", precision="int4")
    calls = recorded(tmp_path / "calls.npz")
    four, both = trials_of(tmp_path / "int4", calls), ["condition", "blocks"]
    eight_off = proposed(Precision(request()), trials, trials.base)[0].notes["alone"]
    (found,) = proposed(proposer := Precision(request()), four, four.base)
    assert dict(found.plan.precision) == dict.fromkeys(both, "int4") and proposer.told == "int4 in condition and blocks"
    assert all(found.notes["alone"][part] > 2 * eight_off[part] for part in both)
    assert 0.02 < further(judge(four, found.plan, LEARNED), judge(four, four.base.exact, LEARNED))[1] < Precision.margin
    (found,) = proposed(proposer := Precision(request(margin=0.02)), four, four.base)
    assert not found.plan.precision
    assert proposer.told == "all parts stay fp32: int4 changes the actions more than 0.02 allows"
    calibrate(tmp_path / "int4", calls, learn=("precision",), progress=False)
    assert ttscompile.load(tmp_path / "int4").info.precision == "int4"


def test_the_worst_part_is_left_out_first(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    both, far, near = ("condition", "blocks"), 3 * Precision.margin, 0.9 * Precision.margin
    limits = {(): 0.0, both: far, ("condition",): near, ("blocks",): 2 * near}
    scripted(monkeypatch, limits)
    assert tuple(proposed(Precision(request()), trials, trials.base)[0].plan.precision) == ("condition",)
    scripted(monkeypatch, {**limits, ("condition",): far})
    proposer = Precision(request(margin=2 * Precision.margin))
    assert tuple(proposed(proposer, trials, trials.base)[0].plan.precision) == ("blocks",)
    scripted(monkeypatch, {**limits, both: near})
    assert tuple(proposed(Precision(request()), trials, trials.base)[0].plan.precision) == both


def test_all_is_fp32_where_nothing_is_within_the_margin(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    scripted(monkeypatch, {(): 0.0, ("condition", "blocks"): 9.0, ("condition",): 9.0, ("blocks",): 8.0})
    proposer = Precision(request())
    (found,) = proposed(proposer, trials, trials.base)
    assert not found.plan.precision
    assert proposer.told == "all parts stay fp32: int8 changes the actions more than 0.1 allows"


@pytest.mark.slow
def test_one_part_is_not_tried_twice(once: Once, recording: Path, tmp_path: Path) -> None:
    """A schedule of a policy that does not see keeps its cells."""
    folder = Path(shutil.copytree(policies.compiled(once, "int8"), tmp_path / "int8"))
    trials = trials_of(folder, [recording])
    plan = replace(trials.base, cells=whole_steps_plan(policies.STEPS, 2 * policies.LAYERS, [0, 5]))
    (found,) = proposed(Precision(request(margin=1.0)), trials, plan)
    assert found.plan.cells is plan.cells and dict(found.plan.precision) == {"blocks": "int8"}
    assert found.notes["alone"] == {}


def test_an_artifact_in_fp32_has_nothing_to_choose(compiled: Path, once: Once) -> None:
    assert "make it again with --precision int8, in Python precision=" in str(
        Precision(request()).applies(load_artifact(compiled))
    )
    assert Precision(request()).applies(load_artifact(policies.compiled(once, "int8"))) is None
