"""Weights of their own, from end to end on a small policy: what plan ``distilled`` is, and what it leaves as it was."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.artifact.folders import contents
from tests.calibration import policies
from tests.calibration.killed import killed
from tests.once import Once
from tests.plans import store_schedules
from ttscompile.artifact import codec, tensors
from ttscompile.artifact.files import describe
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import MANIFEST
from ttscompile.artifact.view import View, view_of
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.kept import Kept
from ttscompile.calibration.pipeline import CalibrationResult, calibrate
from ttscompile.calibration.proposers import weights as student
from ttscompile.calibration.proposers.weights import NAME, SAVED, Weights
from ttscompile.calibration.sparse_loop import fit_correction
from ttscompile.calibration.state import FILE
from ttscompile.calibration.trials import Trials
from ttscompile.core.correction import no_correction
from ttscompile.core.lattice import whole_steps_plan
from ttscompile.core.plan import DENSE, Plan
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError
from ttscompile.report import facts
from ttscompile.report.push import card
from ttscompile.runtimes.open import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.verification import verify
from ttscompile.verification.record_golden import record_plans
from ttscompile.verification.reuse import ENGAGED

from .trying import proposed, request, trials_of

Noise = ttscompile.Noise
Trained = tuple[Path, CalibrationResult]
UPDATES = 24


def train(directory: Path, recording: Path, **changes: Any) -> CalibrationResult:
    learned = {"learn": ("weights",), "rank": 4, "updates": UPDATES, "progress": False}
    return calibrate(directory, [recording], **{**learned, **changes})


@pytest.fixture(scope="module")
def distilled(scheduled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A distilled artifact and the result; not to be changed."""
    directory = Path(shutil.copytree(scheduled, tmp_path_factory.mktemp("distilled") / "compiled"))
    return directory, train(directory, recording)


@pytest.fixture
def copied(scheduled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scheduled, tmp_path / "compiled"))


def call(seed: int, streams: int = 3) -> tuple[dict[str, Any], Noise]:
    draw = np.random.default_rng(seed)
    shape = (streams, policies.HORIZON, policies.CHANNELS)
    steps = draw.standard_normal((policies.STEPS, *shape), dtype=np.float32)
    obs = {"obs": draw.standard_normal((streams, 2, 3)).astype(np.float32)}
    return obs, Noise(draw.standard_normal(shape, dtype=np.float32), steps)


def actions(policy: CompiledPolicy, plan: str, seed: int = 0) -> Any:
    obs, noise = call(seed)
    return policy.predict_action(obs, noise=noise, plan=plan)["action_pred"]


@pytest.mark.slow
def test_the_artifact_gets_a_plan_that_is_nearer_to_the_dense_policy(distilled: Trained, scheduled: Path) -> None:
    directory, result = distilled
    artifact = load_artifact(directory)
    assert result.plans[NAME].distance < result.plans["schedule"].distance
    assert f"9 matrices of blocks were trained in {UPDATES} updates" in result.told["weights"]
    assert result.stopped == "finished"
    assert artifact.manifest.default_plan == NAME
    np.testing.assert_array_equal(artifact.plans[NAME].cells, load_artifact(scheduled).plans["schedule"].cells)
    assert artifact.plans[NAME].weights == NAME and artifact.plans["schedule"].weights == "original"
    record = artifact.manifest.calibration
    assert record is not None
    assert record["plans"][NAME]["distance"] == result.plans[NAME].distance


@pytest.mark.slow
def test_people_are_told_that_it_is_another_network(distilled: Trained, scheduled: Path) -> None:
    artifact = load_artifact(distilled[0])
    record = artifact.manifest.calibration
    assert record is not None
    remarks = facts.remarks(record)
    assert f"Learned, weights: 9 matrices of blocks were trained in {UPDATES} updates." in remarks
    assert any("is another network" in remark for remark in remarks)
    assert "--learn interval,weights`" in card(artifact, "org/name", [], [], None)
    assert "--learn interval`" in card(load_artifact(scheduled), "o/n", [], [], None)


@pytest.mark.slow
def test_all_other_plans_are_what_they_were(scheduled: Path, distilled: Trained) -> None:
    before, after = ttscompile.load(scheduled), ttscompile.load(distilled[0])
    assert after.info.default_plan == NAME
    assert after.info.model_identity == before.info.model_identity
    assert after.info.identity != before.info.identity
    actions(after, NAME)
    for plan in (DENSE, "uniform"):
        np.testing.assert_array_equal(actions(after, plan), actions(before, plan))


@pytest.mark.slow
@pytest.mark.parametrize(("runtime", "threads"), [("onnxruntime", 1), ("onnxruntime", 2), ("torch", 1)])
def test_runtimes_give_the_references_answer(distilled: Trained, runtime: str, threads: int) -> None:
    reference = ttscompile.load(distilled[0], runtime="reference")
    policy = ttscompile.load(distilled[0], runtime, threads)
    wanted = actions(reference, NAME)
    np.testing.assert_allclose(actions(policy, NAME), wanted, atol=2e-5)
    assert np.abs(wanted - actions(reference, "schedule")).max() > 1e-2


@pytest.mark.slow
def test_the_module_of_torch_gives_the_references_answer(distilled: Trained) -> None:
    obs, noise = call(0)
    assert noise.steps is not None
    given = {"obs": torch.from_numpy(obs["obs"])}
    made = ttscompile.to_module(distilled[0])(given, torch.from_numpy(noise.initial), torch.from_numpy(noise.steps))
    wanted = actions(ttscompile.load(distilled[0], runtime="reference"), NAME)
    np.testing.assert_allclose(made.numpy(), wanted, atol=2e-5)


@pytest.mark.slow
def test_step_0_has_the_originals_weights_and_later_steps_have_not(distilled: Trained) -> None:
    artifact = load_artifact(distilled[0])
    original, own = (ReferenceModel.from_view(view_of(artifact, plan)) for plan in (DENSE, NAME))
    obs = {"obs": torch.from_numpy(call(1)[0]["obs"])}
    contexts, stream = original.prologue(obs), torch.randn(3, policies.HORIZON, policies.WIDTH)
    assert torch.equal(own.block(1, 0, stream, contexts), original.block(1, 0, stream, contexts))
    assert not torch.equal(own.block(1, 1, stream, contexts), original.block(1, 1, stream, contexts))


@pytest.mark.slow
def test_nothing_is_reused_between_calls_with_different_weights(distilled: Trained) -> None:
    artifact = load_artifact(distilled[0])
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    everything = np.zeros((policies.STEPS, len(artifact.manifest.blocks)), np.int8)
    obs, noise = call(2)
    rollout = everything + 3
    rollout[0] = 0
    policy.predict_action(obs, noise=noise, plan=everything)
    policy.predict_action(obs, noise=noise, plan=rollout)  # reads what the call before computed
    with pytest.raises(ttscompile.TtscompileError, match="noise"):
        policy.predict_action(obs, noise=Noise(noise.initial), plan=NAME)
    policy.predict_action(obs, noise=noise, plan=rollout)  # a refused call changes nothing
    policy.predict_action(obs, noise=noise, plan=NAME)
    with pytest.raises(ttscompile.TtscompileError, match="ROLLOUT"):
        policy.predict_action(obs, noise=noise, plan=rollout)


@pytest.mark.slow
def test_verify_knows_both_sets_of_weights(distilled: Trained, recording: Path, tmp_path: Path) -> None:
    found = verify(distilled[0], [recording], calls=8)
    others = [rung for rung in found.rungs if rung.name != ENGAGED]  # which times calls
    assert {rung.status for rung in others} == {"passed"}, others
    other = Path(shutil.copytree(distilled[0], tmp_path / "exchanged"))
    exchange_weights(other)
    found = verify(other)
    (failed,) = [rung for rung in found.rungs if rung.status == "failed" and rung.name != ENGAGED]
    assert failed.name == "plans" and failed.step is None
    assert "'distilled' is what calibration stored, but its samples differ" in failed.told
    assert "it has a correction and weights of its own: the likely culprit" in failed.told


def exchange_weights(directory: Path) -> None:
    """Weights of another distillation, in an artifact that hashes say is whole."""

    manifest = codec.decode((directory / MANIFEST).read_bytes())
    path = directory / manifest.weights[NAME].weights
    arrays = {name: np.array(value) * 1.1 for name, value in tensors.read(path).items()}
    path.write_bytes(tensors.serialize({name: value.astype(np.float32) for name, value in arrays.items()}))
    manifest = replace(manifest, files={**manifest.files, path.name: describe(path)})
    identity, model = codec.identities(manifest)
    (directory / MANIFEST).write_bytes(codec.encode(replace(manifest, identity=identity, model_identity=model)))


@pytest.mark.slow
@pytest.mark.parametrize("saves", [1, 4])
def test_a_distillation_that_was_killed_goes_on_to_the_same_bytes(
    distilled: Trained, copied: Path, recording: Path, saves: int
) -> None:
    before = load_artifact(copied).manifest.identity
    with killed(saves):
        train(copied, recording)
    assert load_artifact(copied).manifest.identity == before  # the artifact works as it did
    train(copied, recording, resume=True)
    assert contents(copied) == contents(distilled[0])


@pytest.mark.slow
def test_the_rate_of_a_distillation_that_goes_on_is_not_what_it_began_with(
    copied: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update, passed = student.Student.update, list[float]()

    def told(self: student.Student, lesson: student.Lesson, share: float) -> float:
        passed.append(share)
        if len(passed) == SAVED + 2:
            raise KeyboardInterrupt
        return update(self, lesson, share)

    monkeypatch.setattr(student.Student, "update", told)
    with pytest.raises(KeyboardInterrupt):
        train(copied, recording)
    train(copied, recording, resume=True)
    saved, went_on = passed[SAVED - 1], passed[SAVED + 2 :]
    assert len(went_on) == UPDATES - SAVED
    assert passed[0] < saved < went_on[0]


def test_what_was_interrupted_is_not_taken_for_something_else(copied: Path, recording: Path) -> None:
    with killed():
        calibrate(copied, [recording], 0.8, learn=("interval",), progress=False)
    assert (copied / FILE).exists()
    with pytest.raises(CalibrationError, match=r"had other settings: .*learn was \['interval'\], now \['weights'\]"):
        train(copied, recording, resume=True)
    with killed():
        train(copied, recording)
    with pytest.raises(CalibrationError, match="that was interrupted had other settings: rank was 4, now 2"):
        train(copied, recording, rank=2, resume=True)
    artifact = load_artifact(copied)
    update_plans(copied, artifact.plans, "uniform")
    with pytest.raises(CalibrationError, match="that was interrupted had other settings: model was"):
        train(copied, recording, resume=True)  # for another plan than it was begun for


@pytest.mark.slow
def test_the_outcome_does_not_depend_on_the_number_of_threads(
    distilled: Trained, copied: Path, recording: Path
) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if threads > 1 else 2)
    try:
        train(copied, recording)
    finally:
        torch.set_num_threads(threads)
    assert contents(copied) == contents(distilled[0])


def corrected(trials: Trials) -> Plan:
    """The plan of two steps, with what a correction does."""
    cells = whole_steps_plan(policies.STEPS, len(trials.artifact.manifest.blocks), [0, 5])
    return replace(trials.base, cells=cells, correction=fit_correction(trials.runner, cells, trials.calls, True))


def held(trials: Trials, plan: Plan) -> Kept:
    """What is kept of what is proposed from a plan."""
    kept = Kept(trials, anew=False)
    kept.plans["schedule"], kept.default = plan, "schedule"
    (proposal,) = proposed(Weights(request(rank=4, updates=1)), trials, plan)
    kept.consider(proposal)
    return kept


def test_what_is_no_better_is_not_kept(artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trials = trials_of(artifact, [recording])
    monkeypatch.setattr(student, "RATE", 0.0)
    kept = held(trials, corrected(trials))
    assert not kept.learned and "is no better" in kept.refused[NAME]


def test_a_correction_that_does_harm_is_no_excuse(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training mends some of it; the plan as it is is better all the same."""
    trials = trials_of(artifact, [recording])
    plan, harm = corrected(trials), no_correction(policies.STEPS, (policies.HORIZON, policies.CHANNELS))
    name = "ttscompile.calibration.proposers.weights.fit_correction"
    monkeypatch.setattr(name, lambda *_: replace(harm, bias=harm.bias + 1))
    assert "is no better" in held(trials, plan).refused[NAME]


def test_what_a_correction_alone_does_is_no_merit_of_the_weights(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plan without one is proposed with one before its weights are."""
    trials = trials_of(artifact, [recording])
    plan = corrected(trials)
    first, _ = proposed(Weights(request(rank=4, updates=1)), trials, replace(plan, correction=None))
    assert first.name == trials.name and not first.weights
    assert first.plan.correction is not None and plan.correction is not None
    np.testing.assert_array_equal(first.plan.correction.weights, plan.correction.weights)


@pytest.mark.slow
def test_calibrating_again_drops_it(distilled: Trained, recording: Path, tmp_path: Path) -> None:
    directory = policies.whole_steps(Path(shutil.copytree(distilled[0], tmp_path / "compiled")), recording)
    artifact = load_artifact(directory)
    assert not artifact.manifest.weights and NAME not in artifact.manifest.plans
    assert not list(directory.glob("blocks-*"))


@pytest.mark.slow
def test_in_eight_bits(once: Once, recording: Path, tmp_path: Path) -> None:
    directory = Path(shutil.copytree(policies.compiled(once, "int8"), tmp_path / "compiled"))
    train(policies.whole_steps(directory, recording), recording)
    assert {rung.status for rung in verify(directory).rungs if rung.name != ENGAGED} <= {"passed", "skipped"}
    artifact = load_artifact(directory)
    plan = artifact.plans[NAME]
    assert dict(plan.precision) == {"blocks": "int8"}
    exact, own = (ttscompile.load(directory, plan=one) for one in (plan.exact, plan))
    obs, noise = call(0)
    wanted, found = (one.predict_action(obs, noise=noise)["action_pred"] for one in (exact, own))
    with_original = replace(plan.exact, weights="original", correction=None)
    between = np.abs(wanted - exact.predict_action(obs, noise=noise, plan=with_original)["action_pred"]).max()
    assert 0 < np.abs(found - wanted).max() < 0.5 * between


@pytest.mark.parametrize("changes", [{"cells": None}, {"weights": NAME}, {"loop": "other"}])
def test_a_plan_that_cannot_be_distilled(artifact: Path, recording: Path, changes: dict[str, Any]) -> None:
    trials = trials_of(artifact, [recording])
    plan = replace(trials.base, cells=whole_steps_plan(policies.STEPS, 6, [0, 5]))
    with pytest.raises(CalibrationFailedError, match="is another one. Learn 'schedule', which makes"):
        proposed(Weights(request(rank=4)), trials, replace(plan, **changes))


def test_a_schedule_of_single_cells_and_one_that_computes_all_are_refused(artifact: Path, recording: Path) -> None:
    cells = np.full((policies.STEPS, len(load_artifact(artifact).manifest.blocks)), 2, np.int8)
    cells[0] = cells[4, 1] = 0
    for some in (cells, 0 * cells):
        store_schedules(artifact, None, {"schedule": some}, "schedule", {})
        with pytest.raises(CalibrationFailedError, match="of whole steps, two of them computed at least"):
            train(artifact, recording)


def test_a_rank_for_which_nothing_is_large_enough_is_refused(scheduled: Path, recording: Path) -> None:
    before = contents(scheduled)
    with pytest.raises(CalibrationError, match=r"rank 17: expected matrices .* at least 34.*Give a rank of at most 16"):
        train(scheduled, recording, rank=17)
    assert contents(scheduled) == before


@pytest.mark.slow
def test_a_model_of_the_reference_is_there_for_weights_that_are_used(
    scheduled: Path, distilled: Trained, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[View] = []
    from_view = ReferenceModel.from_view

    def counted(view: View) -> ReferenceModel:
        opened.append(view)
        return from_view(view)

    monkeypatch.setattr(ReferenceModel, "from_view", counted)
    assert set(record_plans(load_artifact(scheduled))) == {"schedule", "uniform"}
    assert len(opened) == 1
    assert set(record_plans(load_artifact(distilled[0]))) == {"schedule", "uniform", NAME}
    assert len(opened) == 3


@pytest.mark.parametrize("change", [{"rank": 0}, {"updates": 0}, {"max_minutes": 0.0}, {"validation_fraction": 1.0}])
def test_arguments_that_cannot_be(scheduled: Path, recording: Path, change: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError, match="expected|must be"):
        train(scheduled, recording, **change)


@pytest.mark.slow
def test_a_record_that_does_not_fit_is_refused(distilled: Trained) -> None:
    document = json.loads((distilled[0] / MANIFEST).read_bytes())
    del document["checksum"], document["weights"][NAME]["models"]["block_00"]
    document["checksum"] = codec._checksum(document)
    with pytest.raises(ArtifactError, match="expected a model of each of"):
        codec.decode(json.dumps(document).encode())
