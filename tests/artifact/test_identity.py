"""Two artifacts with one identity compute the same: every name is hashed with what it names."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import ttscompile
from tests.artifact.updates import PLAN, update
from tests.hostile.forged import forge, rehash
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.artifact import load_artifact
from ttscompile.artifact.codec import identities
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.write import finished, update_plans
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactError
from ttscompile.runtimes.random_calls import random_calls

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def trained(written: Path) -> Path:
    """With weights of another kind for its blocks, which a plan takes."""
    own = {n: np.array(a) * 2 for n, a in load_artifact(written).weights.items() if n.startswith("block.")}
    plan = Plan(cells=PLAN, weights="distilled", repair=True)
    update_plans(written, {"mine": plan}, "mine", {}, weights={"distilled": BlockWeights(own, {})})
    return written


def test_models_of_weights_exchanged(trained: Path) -> None:
    """Both are in the artifact, under each other's pieces."""
    manifest = load_artifact(trained).manifest
    weights = manifest.weights["distilled"]
    models = {**weights.models, "block_00": weights.models["block_01"], "block_01": weights.models["block_00"]}
    other = replace(manifest, weights={"distilled": replace(weights, models=models)})
    assert identities(other)[0] != manifest.identity
    assert identities(other)[1] == manifest.model_identity


def test_contents_of_two_files_exchanged(trained: Path) -> None:
    """The records follow; but a model names the file of its weights, and there lies the other's content now."""
    manifest = load_artifact(trained).manifest
    first, second = manifest.stores.weights, manifest.weights["distilled"].weights
    other = replace(
        manifest,
        files={**manifest.files, first: manifest.files[second], second: manifest.files[first]},
        stores=replace(manifest.stores, weights=second),
        weights={"distilled": replace(manifest.weights["distilled"], weights=first)},
    )
    assert identities(other)[0] != manifest.identity
    assert identities(other)[1] != manifest.model_identity


def test_weights_of_another_policy_show_in_the_identity_alone(tmp_path: Path) -> None:
    """Of one shape, with all hashes made anew: it loads and answers, and nothing else tells.

    ``verify`` compares with the original's record, which whoever forges can take from there as well.
    """
    one, other = (written_artifact(toy_program(seed=seed), tmp_path / str(seed)) for seed in (0, 1))
    ((obs, noise),) = random_calls(one.manifest.spec, 1, seed=0)
    before = ttscompile.load(one.path).predict_action(obs, noise=noise)["action"]
    shutil.copy(other.path / "weights.safetensors", one.path / "weights.safetensors")
    forge(one.path)
    forged = ttscompile.load(one.path)
    assert forged.info.identity != one.manifest.identity
    after = forged.predict_action(obs, noise=noise)["action"]
    assert np.isfinite(after).all() and np.abs(after - before).max() > 0.01


@pytest.mark.parametrize("one", ["weights.safetensors", "block_00.onnx", "program.json"])
def test_every_file_but_the_record_of_the_original_is_covered(trained: Path, one: str) -> None:
    manifest = load_artifact(trained).manifest
    other = replace(manifest.files[one], sha256="0" * 64)
    found = identities(replace(manifest, files={**manifest.files, one: other}))
    assert found[0] != manifest.identity
    assert found[1] != manifest.model_identity


def test_what_is_covered_field_by_field(trained: Path) -> None:
    """All that an action depends on; and what people are told is not."""
    manifest = load_artifact(trained).manifest
    assert identities(finished(manifest)[0]) == (manifest.identity, manifest.model_identity)
    plan = manifest.plans["mine"]
    acting = {
        "weights": replace(manifest, plans={"mine": replace(plan, weights="original")}),
        "kind": replace(manifest, plans={"mine": replace(plan, kind="all")}),
        "default": replace(manifest, default_plan="dense"),
        "features": replace(manifest, features=()),
        "group": replace(manifest, blocks=(replace(manifest.blocks[0], group=1), *manifest.blocks[1:])),
    }
    assert all(identities(one)[0] != manifest.identity for one in acting.values())
    told = {
        "sparsity": replace(manifest, plans={"mine": replace(plan, sparsity=0.0)}),
        "record": replace(manifest, calibration={"told": {"a": "b"}}),
        "flops": replace(manifest, flops=replace(manifest.flops, dense=1)),
        "version": replace(manifest, ttscompile_version="9"),
        "requires": replace(manifest, requires=replace(manifest.requires, opset=1)),
    }
    assert {identities(one) for one in told.values()} == {(manifest.identity, manifest.model_identity)}


def test_weights_do_not_lie_in_the_record_of_the_original(written: Path) -> None:
    """No identity covers that record, so no action may depend on it."""
    document = json.loads((written / "manifest.json").read_text())
    (written / "golden.safetensors").write_bytes((written / "weights.safetensors").read_bytes())
    document["stores"]["golden"] = "golden.safetensors"
    document["files"]["golden.safetensors"] = dict(document["files"]["weights.safetensors"])
    rehash(written, document)
    load_artifact(written)
    model = onnx.load(written / "block_00.onnx", load_external_data=False)
    for tensor in model.graph.initializer:
        for entry in tensor.external_data:
            entry.value = "golden.safetensors" if entry.key == "location" else entry.value
    (written / "block_00.onnx").write_bytes(model.SerializeToString())
    rehash(written, document)
    with pytest.raises(ArtifactError, match="in a range of a file of the artifact; found .*golden"):
        load_artifact(written)


HIDDEN = ["\x1b[31mtts", "a\nb", "a\u202eb", "\ud800", "\x9b1m", "\x7f"]


@pytest.mark.parametrize("text", HIDDEN)
@pytest.mark.parametrize("place", ["plan", "version", "kind", "source", "strategy", "told", "loop"])
def test_no_text_of_an_artifact_does_something_to_a_terminal(written: Path, place: str, text: str) -> None:
    update(written)
    document = json.loads((written / "manifest.json").read_text())
    if place == "plan":
        document["plans"] = {text: next(iter(document["plans"].values()))}
    elif place == "version":
        document["ttscompile_version"] = text
    elif place == "kind":
        document["blocks"][0]["kind"] = text
    elif place == "source":
        document["spec"]["source"] = {text: "a"}
    elif place == "loop":
        document["starts"] = {text: {"loop": "original", "steps": 1}}
    else:
        document["calibration"] = {"strategy": text} if place == "strategy" else {"told": {"schedule": [text]}}
    rehash(written, document)
    with pytest.raises(ArtifactError) as raised:
        load_artifact(written)
    assert all(character.isprintable() for character in str(raised.value))


@pytest.mark.parametrize("name", ["", "a" * 65, "-a", "a b", "a@fp32"])
def test_names_of_plans_are_held_to_what_they_are_written_by(written: Path, name: str) -> None:
    update(written)
    document = json.loads((written / "manifest.json").read_text())
    document["plans"][name] = document["plans"].pop("mine")
    rehash(written, document)
    with pytest.raises(ArtifactError, match=r"expected letters, digits and _ \. % -"):
        load_artifact(written)


@pytest.mark.parametrize(
    ("record", "place"),
    [
        ({"plans": {"mine": {"error": 10**400}}}, "calibration.plans.mine.error: expected a finite number"),
        ({"plans": {"mine": {"distance": "near"}}}, "calibration.plans.mine.distance: expected a number"),
        ({"plans": {"mine": 3}}, "calibration.plans.mine: expected an object"),
        ({"plans": []}, "calibration.plans: expected an object"),
        ({"other_noise": "1"}, "calibration.other_noise: expected a number"),
        ({"policy_hz": 0.0}, "calibration.policy_hz: expected a positive number"),
        ({"policy_hz": "10"}, "calibration.policy_hz: expected a number"),
        ({"seed": 10**30}, "calibration.seed: expected a 64-bit integer"),
        ({"learned": "schedule"}, "calibration.learned: expected a list"),
        ({"learned": [1]}, r"calibration.learned\[0\]: expected a string"),
        ({"budget": {"latency_ms": [1]}}, "calibration.budget.latency_ms: expected a number"),
        ({"episodes": {"validation": [1.5]}}, r"calibration.episodes.validation\[0\]: expected an integer"),
        ({"calls": {"validation": None}}, "calibration.calls.validation: expected an integer"),
        ({"skipped": {"fast": 1}}, "calibration.skipped.fast: expected a string"),
        ({"told": {"weights": ["a"]}}, "calibration.told.weights: expected a string"),
        ({"frontier": {}}, "calibration.frontier: expected a list"),
        ({"timed_on": 3}, "calibration.timed_on: expected a string"),
        ({"frontier": [{"calls": 1.5}]}, r"calibration.frontier\[0\].calls: expected an integer"),
        ({"frontier": [{"name": "a"}, {"worst": "1"}]}, r"calibration.frontier\[1\].worst: expected a number"),
    ],
)
def test_what_commands_read_of_a_record_has_its_type(written: Path, record: dict[str, Any], place: str) -> None:
    update(written)
    document = json.loads((written / "manifest.json").read_text())
    document["calibration"] = record
    rehash(written, document)
    with pytest.raises(ArtifactError, match=place):
        load_artifact(written)
    document["calibration"] = {"of_mine": [10**400, {"error": "near"}], "plans": {"mine": {"error": None, "x": "y"}}}
    rehash(written, document)
    assert load_artifact(written).manifest.calibration == document["calibration"], "the rest is free"
