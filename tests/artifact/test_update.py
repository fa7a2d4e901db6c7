import errno
import fcntl
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.artifact.folders import contents, failing, packed
from tests.artifact.tiny import tiny_program, write_tiny
from tests.artifact.updates import PLAN, RECORD, new_pruner, update
from tests.rounding import assert_equal_but_for_rounding
from ttscompile.artifact import load_artifact
from ttscompile.artifact.manifest import PlanRecord, StartRecord
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.write import update_plans
from ttscompile.core.plan import Plan, TokenReuse
from ttscompile.errors import ArtifactError, IllegalPlanError


def logits(path: Path) -> np.ndarray:
    import onnxruntime

    artifact = load_artifact(path)
    model = artifact.path / artifact.manifest.pieces["pruner"].file
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"memory": np.ones((2, 1, 16), np.float32)})[0])


def test_plans_weights_and_record_are_replaced(written: Path) -> None:
    before = load_artifact(written).manifest
    old = logits(written)
    pruner = new_pruner(written)
    returned = update(written)
    artifact = load_artifact(written)
    manifest = artifact.manifest
    assert manifest.identity == returned.identity != before.identity
    assert manifest.model_identity == before.model_identity
    assert manifest.default_plan == "tts"
    assert manifest.plans == {
        "mine": PlanRecord("schedule", sparsity=0.5, flops_sparsity=0.5),
        "tts": PlanRecord("pruner", sparsity=0.75, flops_sparsity=None),
    }
    assert manifest.calibration == RECORD
    np.testing.assert_array_equal(artifact.plans["mine"].cells, PLAN)
    for name, value in pruner.items():
        assert artifact.pruner[name].tobytes() == value.tobytes()
    # All weights one larger, on 16 inputs of one; the bias is small enough to be in the model and has to follow too.
    assert_equal_but_for_rounding(logits(written), old + 17, terms=17 + 17)
    assert set(contents(written)) == {"manifest.json", *manifest.files}
    shared = set(before.files) & set(manifest.files)
    assert shared == {name for name in before.files if not name.startswith("pruner")}


def test_an_update_equals_a_fresh_one_byte_by_byte(written: Path, tmp_path: Path) -> None:
    update(written)
    once = contents(written)
    update(written, by=0)
    assert contents(written) == once
    update(written, by=5, schedules={}, default_plan="other")
    update(written, by=-5)
    write_tiny(tmp_path / "b")
    update(tmp_path / "b", by=0, pruner_weights=load_artifact(written).pruner)
    assert contents(tmp_path / "b") == contents(written)


def test_schedules_alone(written: Path) -> None:
    update(written)
    before = load_artifact(written)
    manifest = update(written, pruner_weights=None, schedules={"a": PLAN, "b-95%": PLAN * 0}, default_plan="a")
    assert {name: plan.kind for name, plan in manifest.plans.items()} == {"a": "schedule", "b-95%": "all"}
    assert manifest.stores.pruner == before.manifest.stores.pruner
    assert manifest.plans["b-95%"].flops_sparsity == 0
    manifest = update(written, pruner_weights=None, schedules={}, default_plan="dense", record={})
    assert (manifest.plans, manifest.default_plan, manifest.stores.plans) == ({}, "dense", None)
    assert manifest.calibration == {}
    load_artifact(written)


def test_the_pruner_beside_a_default_schedule(written: Path) -> None:
    """What was measured of each stands in its own record, whichever of the two is the default."""
    record = {"plans": {"pruner": {"sparsity": 0.75, "flops_sparsity": 0.5}, "mine": {"sparsity": 0.5}}}
    beside = update(written, default_plan="mine", record=record).plans
    assert beside == {
        "mine": PlanRecord("schedule", sparsity=0.5, flops_sparsity=0.5),
        "pruner": PlanRecord("pruner", sparsity=0.75, flops_sparsity=0.5),
    }
    assert set(update(written, default_plan="dense", schedules={}).plans) == {"pruner"}


BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"schedules": {"dense": PLAN}}, ArtifactError, "plan 'dense': expected another name"),
    ({"schedules": {"../x": PLAN}}, ArtifactError, "plan '../x'"),
    ({"schedules": {"": PLAN}}, ArtifactError, "plan ''"),
    ({"schedules": {"a": PLAN[:2]}}, IllegalPlanError, "'a': plan has shape"),
    ({"schedules": {"a": PLAN.astype(np.int64)}}, IllegalPlanError, "int64"),
    ({"schedules": {"a": PLAN[::-1]}}, IllegalPlanError, "step 0"),
    ({"pruner_weights": None}, ArtifactError, "default plan 'tts'"),
    ({"pruner_weights": {}}, ArtifactError, "3 differ"),
    ({"default_plan": "no such name!"}, ArtifactError, "expected letters, digits"),
    ({"record": {"x": float("nan")}}, ArtifactError, "expected JSON"),
    ({"record": {"x": np.zeros(2)}}, ArtifactError, "expected JSON"),
    ({"record": {"plans": {"tts": {"sparsity": 1.5}}}}, ArtifactError, r"sparsity: expected a number in 0\.\.1"),
    ({"model_identity": "0" * 64}, ArtifactError, "converted again"),
]


@pytest.mark.parametrize(("changes", "error", "message"), BAD)
def test_arguments_that_do_not_fit(
    written: Path, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    before = contents(written)
    with pytest.raises(error, match=message):
        update(written, **changes)
    assert contents(written) == before


FIELDS: list[tuple[dict[str, Any], str]] = [
    ({"loop": "ddim-2"}, r"plan 'mine': expected a loop, one of \['original'\]"),
    ({"weights": "trained"}, r"plan 'mine': expected weights, one of \['original'\]"),
    ({"precision": {"blocks": "int8"}}, "plan 'mine': expected parts in the precision that the artifact has models in"),
    ({"tokens": TokenReuse(0.1, 8)}, "plan 'mine': expected no reuse of tokens"),
    ({"otherwise": Plan()}, r"plan 'mine': its plan for calls without a chunk is none of"),
]


@pytest.mark.parametrize(("fields", "message"), FIELDS)
def test_a_plan_that_names_what_the_artifact_lacks_is_not_written(
    written: Path, fields: dict[str, Any], message: str
) -> None:
    before = contents(written)
    with pytest.raises(ArtifactError, match=message):
        update_plans(written, {"mine": Plan(cells=PLAN, **fields)}, "mine", {})
    assert contents(written) == before


def test_what_no_plan_names_any_more_is_gone(written: Path) -> None:
    """Weights and starts belong to the plans that name them."""
    start, weights = {"last-2": StartRecord("original", 2)}, {"own": BlockWeights({}, {})}
    dense = load_artifact(written).plans["dense"]
    plans = {"dense": dense, "mine": Plan(cells=PLAN, weights="own")}
    plans["warm"] = Plan("last-2", PLAN[:2] * 0, otherwise=dense)
    manifest = update_plans(written, plans, "mine", {}, weights=weights, starts=start)
    assert (set(manifest.weights), set(manifest.starts)) == ({"own"}, {"last-2"})
    loaded = load_artifact(written).plans
    assert loaded["mine"].weights == "own"
    assert loaded["warm"].otherwise is loaded["dense"]
    manifest = update_plans(written, {"dense": loaded["dense"], "warm": loaded["warm"]}, "warm")
    assert (set(manifest.weights), set(manifest.starts)) == (set(), {"last-2"})
    assert set(contents(written)) == {"manifest.json", *manifest.files}
    whole = {**plans, "warm": replace(plans["warm"], cells=PLAN * 0)}
    with pytest.raises(ArtifactError, match="fewer steps than the 3 of loop 'original'"):
        update_plans(written, whole, "warm", starts={"last-2": StartRecord("original", 3)}, weights=weights)


@pytest.mark.parametrize("edit", ["dtype", "shape", "name"])
def test_pruner_weights_of_another_type(written: Path, edit: str) -> None:
    pruner = new_pruner(written)
    if edit == "dtype":
        pruner["pruner.bias"] = pruner["pruner.bias"].astype(np.float64)
    elif edit == "shape":
        pruner["pruner.bias"] = pruner["pruner.bias"][None]
    else:
        pruner["pruner.offset"] = pruner.pop("pruner.bias")
    before = contents(written)
    with pytest.raises(ArtifactError, match="'pruner.bias'"):
        update(written, pruner_weights=pruner)
    assert contents(written) == before


def test_what_cannot_be_updated(written: Path, tmp_path: Path) -> None:
    pruner = new_pruner(written)
    with pytest.raises(ArtifactError, match="Unzip it"):
        update(packed(written), pruner_weights=pruner)
    with pytest.raises(ArtifactError, match="does not exist"):
        update(tmp_path / "none", pruner_weights=pruner)
    (written / "stem.onnx").unlink()
    with pytest.raises(ArtifactError, match="missing"):
        update(written, pruner_weights=pruner)


def test_one_at_a_time(written: Path) -> None:
    program = tiny_program()
    descriptor = os.open(written, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        with pytest.raises(ArtifactError, match="another process is changing the artifact"):
            update(written)
        with pytest.raises(ArtifactError, match="another process is changing the artifact"):
            write_tiny(written, program)
    finally:
        os.close(descriptor)
    update(written)


def test_a_file_system_without_locks_is_an_error(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    before = contents(written)
    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", refusing)
        with pytest.raises(ArtifactError, match="cannot be locked, and was not changed: .*No locks available"):
            update(written)
    assert contents(written) == before


def test_an_open_artifact_survives_an_update(written: Path) -> None:
    artifact = load_artifact(written)
    before = {name: np.array(value) for name, value in artifact.pruner.items()}
    update(written)
    for name, value in before.items():
        assert artifact.pruner[name].tobytes() == value.tobytes()


@pytest.mark.parametrize("function", ["replace", "fsync"])
def test_failure_anywhere_leaves_the_old_or_the_new(
    written: Path, monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    update(written, by=3)
    before = contents(written)
    pruner = new_pruner(written)
    original = getattr(os, function)
    outcomes: list[str] = []
    messages: list[str] = []
    for fail_at in range(100):
        with monkeypatch.context() as patch:
            patch.setattr(os, function, failing(original, fail_at, OSError))
            try:
                update(written, pruner_weights=pruner, schedules={"new": PLAN}, default_plan="new")
                break
            except ArtifactError as error:
                messages.append(str(error))
        outcomes.append("old" if contents(written) == before else load_artifact(written).manifest.default_plan)
        if outcomes[-1] == "new":
            break
    assert outcomes.count("old") >= 4
    assert set(outcomes) <= {"old", "new"}
    assert all("no space left on device" in message for message in messages)
    manifest = load_artifact(written).manifest
    assert manifest.default_plan == "new"
    assert set(contents(written)) == {"manifest.json", *manifest.files}
