"""Distillation from end to end on a small policy: what the plan ``distilled`` is, and what it leaves as it was."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import ttscompile
from tests.once import Once
from ttscompile.artifact import codec, tensors
from ttscompile.artifact.files import describe
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.manifest import DENSE, DISTILLED, MANIFEST
from ttscompile.artifact.write import update_calibration
from ttscompile.calibration import student
from ttscompile.calibration.distill import SAVED, Distilled, distill
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.state import FILE
from ttscompile.cli import main
from ttscompile.core.correction import no_correction
from ttscompile.errors import ArtifactError, CalibrationError, CalibrationFailedError
from ttscompile.report import facts
from ttscompile.report.card import card
from ttscompile.runtimes.open import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.verification import verify
from ttscompile.verification.engaged import ENGAGED
from ttscompile.verification.record_golden import record_plans

from . import policies
from .killed import killed

Noise = ttscompile.Noise
UPDATES = 24


def train(directory: Path, recording: Path, **changes: Any) -> Distilled:
    return distill(directory, [recording], **{"rank": 4, "updates": UPDATES, "progress": False, **changes})


@pytest.fixture(scope="module")
def distilled(scheduled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Distilled]:
    """A distilled artifact and the result; not to be changed."""
    directory = Path(shutil.copytree(scheduled, tmp_path_factory.mktemp("distilled") / "compiled"))
    return directory, train(directory, recording)


@pytest.fixture
def copied(scheduled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scheduled, tmp_path / "compiled"))


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


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
def test_the_artifact_gets_a_plan_that_is_nearer_to_the_dense_policy(distilled: tuple[Path, Distilled]) -> None:
    directory, result = distilled
    artifact = load_artifact(directory)
    assert result.after.error < result.before.error
    assert (result.updates, result.stopped) == (UPDATES, "finished")
    assert artifact.manifest.default_plan == DISTILLED
    np.testing.assert_array_equal(artifact.schedule(DISTILLED), artifact.schedule("schedule"))
    record = artifact.manifest.calibration
    assert record is not None
    assert record["distilled"] == json.loads(json.dumps(result.record()))
    assert record["plans"][DISTILLED]["error"] == result.after.error


@pytest.mark.slow
def test_the_command_says_what_it_did(copied: Path, recording: Path) -> None:
    options = ["--rank", "4", "--updates", str(UPDATES), "--max-minutes", "5"]
    done = CliRunner().invoke(main, ["distill", str(copied), "--trajectories", str(recording), *options])
    assert done.exit_code == 0, done.stderr
    assert "weights of its own: 9 matrices of blocks were trained" in " ".join(done.stdout.split())
    again = CliRunner().invoke(main, ["distill", str(copied), "--trajectories", str(recording), "--plan", "other"])
    assert again.exit_code == 2
    assert "has no schedule 'other' that could be distilled. Give one of ['" in again.stderr


def test_people_are_told_that_it_is_another_network(distilled: tuple[Path, Distilled]) -> None:
    artifact, result = load_artifact(distilled[0]), distilled[1]
    record = artifact.manifest.calibration
    assert record is not None and record["default_plan"] == DISTILLED
    (remark,) = [one for one in facts.remarks(record) if "'distilled'" in one]
    assert "the schedule of plan 'schedule' and weights of its own: 9 matrices" in remark
    assert f"from {result.before.error:.4g} to {result.after.error:.4g}" in remark
    steps = card(artifact, "org/name", [], [], None)
    assert f"`ttscompile distill DIR --trajectories CALLS --plan schedule --rank 4 --updates {UPDATES}`" in steps
    assert (
        "distill"
        not in card(
            replace(artifact, manifest=replace(artifact.manifest, distilled=None)), "o/n", [], [], None
        ).partition("How it was made")[2]
    )


def test_all_other_plans_are_what_they_were(scheduled: Path, distilled: tuple[Path, Distilled]) -> None:
    before, after = ttscompile.load(scheduled), ttscompile.load(distilled[0])
    assert after.info.default_plan == DISTILLED
    assert after.info.model_identity == before.info.model_identity
    assert after.info.identity != before.info.identity
    actions(after, DISTILLED)
    for plan in (DENSE, "schedule", "uniform"):
        np.testing.assert_array_equal(actions(after, plan), actions(before, plan))


@pytest.mark.parametrize(("runtime", "threads"), [("onnxruntime", 1), ("onnxruntime", 2), ("torch", 1)])
def test_runtimes_give_the_references_answer(distilled: tuple[Path, Distilled], runtime: str, threads: int) -> None:
    reference = ttscompile.load(distilled[0], runtime="reference")
    policy = ttscompile.load(distilled[0], runtime, threads)
    wanted = actions(reference, DISTILLED)
    np.testing.assert_allclose(actions(policy, DISTILLED), wanted, atol=2e-5)
    assert np.abs(wanted - actions(reference, "schedule")).max() > 1e-2


def test_the_module_of_torch_gives_the_references_answer(distilled: tuple[Path, Distilled]) -> None:
    obs, noise = call(0)
    assert noise.steps is not None
    given = {"obs": torch.from_numpy(obs["obs"])}
    made = ttscompile.to_module(distilled[0])(given, torch.from_numpy(noise.initial), torch.from_numpy(noise.steps))
    wanted = actions(ttscompile.load(distilled[0], runtime="reference"), DISTILLED)
    np.testing.assert_allclose(made.numpy(), wanted, atol=2e-5)


def test_step_0_has_the_originals_weights_and_later_steps_have_not(distilled: tuple[Path, Distilled]) -> None:
    artifact = load_artifact(distilled[0])
    original, own = (ReferenceModel.from_artifact(artifact.with_weights_of(plan)) for plan in (None, DISTILLED))
    obs = {"obs": torch.from_numpy(call(1)[0]["obs"])}
    contexts, stream = original.prologue(obs), torch.randn(3, policies.HORIZON, policies.WIDTH)
    assert torch.equal(own.block(1, 0, stream, contexts), original.block(1, 0, stream, contexts))
    assert not torch.equal(own.block(1, 1, stream, contexts), original.block(1, 1, stream, contexts))


def test_nothing_is_reused_between_calls_with_different_weights(distilled: tuple[Path, Distilled]) -> None:
    artifact = load_artifact(distilled[0])
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    everything = np.zeros((policies.STEPS, len(artifact.manifest.blocks)), np.int8)
    obs, noise = call(2)
    rollout = everything + 3
    rollout[0] = 0
    policy.predict_action(obs, noise=noise, plan=everything)
    policy.predict_action(obs, noise=noise, plan=rollout)  # reads what the call before computed
    with pytest.raises(ttscompile.TtscompileError, match="noise"):
        policy.predict_action(obs, noise=Noise(noise.initial), plan=DISTILLED)
    policy.predict_action(obs, noise=noise, plan=rollout)  # a refused call changes nothing
    policy.predict_action(obs, noise=noise, plan=DISTILLED)
    with pytest.raises(ttscompile.TtscompileError, match="ROLLOUT"):
        policy.predict_action(obs, noise=noise, plan=rollout)


def test_verify_knows_both_sets_of_weights(distilled: tuple[Path, Distilled], recording: Path, tmp_path: Path) -> None:
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
    assert manifest.distilled is not None
    path = directory / manifest.distilled.weights
    arrays = {name: np.array(value) * 1.1 for name, value in tensors.read(path).items()}
    path.write_bytes(tensors.serialize({name: value.astype(np.float32) for name, value in arrays.items()}))
    manifest = replace(manifest, files={**manifest.files, path.name: describe(path)})
    identity, model = codec.identities(manifest)
    (directory / MANIFEST).write_bytes(codec.encode(replace(manifest, identity=identity, model_identity=model)))


@pytest.mark.slow
@pytest.mark.parametrize("saves", [1, 4])
def test_a_distillation_that_was_killed_goes_on_to_the_same_bytes(
    distilled: tuple[Path, Distilled], copied: Path, recording: Path, saves: int
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


def test_an_interrupted_calibration_and_an_interrupted_distillation_do_not_know_each_other(
    copied: Path, recording: Path
) -> None:
    with killed():
        calibrate(copied, [recording], 0.8, "interval", progress=False)
    with killed():
        train(copied, recording, resume=True)  # there is nothing of its own to resume
    assert (copied / FILE).exists()
    with pytest.raises(
        CalibrationError, match="the distillation that was interrupted had other settings: rank was 4, now 2"
    ):
        train(copied, recording, rank=2, resume=True)


@pytest.mark.slow
def test_the_outcome_does_not_depend_on_the_number_of_threads(
    distilled: tuple[Path, Distilled], copied: Path, recording: Path
) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if threads > 1 else 2)
    try:
        train(copied, recording)
    finally:
        torch.set_num_threads(threads)
    assert contents(copied) == contents(distilled[0])


@pytest.mark.slow
def test_what_is_no_better_is_not_kept(copied: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(copied)
    monkeypatch.setattr(student, "RATE", 0.0)
    with pytest.raises(CalibrationFailedError, match="after 1 updates. The artifact is as it was"):
        train(copied, recording, updates=1)
    assert {name: one for name, one in contents(copied).items() if name in before} == before


def test_a_correction_that_does_harm_is_no_excuse(
    copied: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training mends some of it; the plan as it is, without one, is better all the same."""
    harm = no_correction(policies.STEPS, (policies.HORIZON, policies.CHANNELS))
    monkeypatch.setattr("ttscompile.calibration.distill.fit_correction", lambda *_: replace(harm, bias=harm.bias + 1))
    with pytest.raises(CalibrationFailedError, match="The artifact is as it was"):
        train(copied, recording, updates=4)


def test_calibrating_again_drops_it(distilled: tuple[Path, Distilled], recording: Path, tmp_path: Path) -> None:
    directory = policies.whole_steps(Path(shutil.copytree(distilled[0], tmp_path / "compiled")), recording)
    artifact = load_artifact(directory)
    assert artifact.manifest.distilled is None and DISTILLED not in artifact.manifest.plans
    assert not list(directory.glob("distilled*"))


@pytest.mark.slow
def test_in_eight_bits(once: Once, recording: Path, tmp_path: Path) -> None:
    directory = Path(shutil.copytree(policies.compiled(once, "int8"), tmp_path / "compiled"))
    train(policies.whole_steps(directory, recording), recording)
    assert {rung.status for rung in verify(directory).rungs if rung.name != ENGAGED} <= {"passed", "skipped"}
    exact, own = ttscompile.load(directory, precision="fp32"), ttscompile.load(directory)
    wanted, found = actions(exact, DISTILLED), actions(own, DISTILLED)
    between = np.abs(wanted - actions(exact, "schedule")).max()
    assert 0 < np.abs(found - wanted).max() < 0.5 * between
    view = load_artifact(directory).with_weights_of(DISTILLED)
    for plain in (view.at_precision("fp32"), view.with_parts([])):
        assert plain.first_step is not None and plain.first_step.manifest.precision is None


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ("pruner", r"no schedule 'pruner' that could be distilled. Give one of \['schedule', 'uniform'\]"),
        (DISTILLED, r"no schedule 'distilled' that could be distilled. Give one of \['schedule', 'uniform'\]"),
    ],
)
def test_a_plan_that_cannot_be_distilled(scheduled: Path, recording: Path, plan: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        train(scheduled, recording, plan=plan)


def test_a_schedule_of_single_cells_is_refused(artifact: Path, recording: Path) -> None:
    plan = np.full((policies.STEPS, len(load_artifact(artifact).manifest.blocks)), 2, np.int8)
    plan[0] = plan[4, 1] = 0
    update_calibration(artifact, None, {"schedule": plan}, "schedule", {})
    with pytest.raises(CalibrationError, match="expected whole steps, at least two of them computed"):
        train(artifact, recording)


def test_an_artifact_that_is_not_calibrated_is_refused(compiled: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match="Calibrate the artifact first"):
        train(compiled, recording)


def test_a_rank_for_which_nothing_is_large_enough_is_refused(scheduled: Path, recording: Path) -> None:
    before = contents(scheduled)
    with pytest.raises(CalibrationError, match=r"rank 17: expected matrices .* at least 34.*Give a rank of at most 16"):
        train(scheduled, recording, rank=17)
    assert contents(scheduled) == before


def test_a_model_of_the_reference_is_there_for_weights_that_are_used(
    scheduled: Path, distilled: tuple[Path, Distilled], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Artifact] = []
    from_artifact = ReferenceModel.from_artifact

    def counted(artifact: Artifact) -> ReferenceModel:
        opened.append(artifact)
        return from_artifact(artifact)

    monkeypatch.setattr(ReferenceModel, "from_artifact", counted)
    assert set(record_plans(load_artifact(scheduled))) == {"schedule", "uniform"}
    assert len(opened) == 1
    assert set(record_plans(load_artifact(distilled[0]))) == {"schedule", "uniform", DISTILLED}
    assert len(opened) == 3


@pytest.mark.parametrize("change", [{"rank": 0}, {"updates": 0}, {"max_minutes": 0.0}, {"validation_fraction": 1.0}])
def test_arguments_that_cannot_be(scheduled: Path, recording: Path, change: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError, match="expected|must be"):
        train(scheduled, recording, **change)


def test_a_record_that_does_not_fit_is_refused(distilled: tuple[Path, Distilled]) -> None:
    document = json.loads((distilled[0] / MANIFEST).read_bytes())
    del document["checksum"], document["distilled"]["models"]["block_00"]
    document["checksum"] = codec._checksum(document)
    with pytest.raises(ArtifactError, match="distilled: expected a model of each of"):
        codec.decode(json.dumps(document).encode())
