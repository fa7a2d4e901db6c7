"""Blocks of another precision in an artifact: beside fp32, hashed, chosen by a plan; hostile manifests."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

import ttscompile
from tests.artifact.folders import contents, flip, packed
from tests.artifact.tiny import HORIZON, WIDTH, tiny_models, tiny_program
from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile.artifact import bind, codec, tensors
from ttscompile.artifact.bind import LoweredPieces
from ttscompile.artifact.codec import identities
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.artifact.manifest import Manifest
from ttscompile.artifact.strict_json import Value
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import write_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import ArtifactError
from ttscompile.ir.pieces import DENSE_STEP, JOINT
from ttscompile.lower.joint import lower_all_blocks
from ttscompile.lower.precision import lower_precision, quantize_model
from ttscompile.runtimes.random_calls import random_calls


def lowered(seed: int = 0) -> LoweredPieces:
    program = tiny_program(seed)
    models, weights, _ = lower_precision(tiny_models(program), program.weights, "int8")
    whole = lower_all_blocks(program.pieces.blocks, models)
    return LoweredPieces("int8", {**models, **whole}, weights)


def write(directory: Path, blocks: LoweredPieces | None) -> Path:
    program = tiny_program()
    write_artifact(program, tiny_models(program), directory, blocks)
    return directory


@pytest.fixture
def int8(tmp_path: Path) -> Path:
    return write(tmp_path / "int8", lowered())


def test_fp32_stays_and_the_rest_comes_beside_it(int8: Path, tmp_path: Path) -> None:
    plain, both = contents(write(tmp_path / "fp32", None)), contents(int8)
    own = {"weights_int8.safetensors", *(f"{name}_int8.onnx" for name in ("block_00", "block_01", JOINT, DENSE_STEP))}
    assert set(both) - set(plain) == own
    assert {name for name in plain if plain[name] != both[name]} == {"manifest.json"}
    assert b'"precision": null' in plain["manifest.json"]
    assert len(both["weights_int8.safetensors"]) < 0.5 * 2 * 4 * WIDTH * WIDTH + 1024


def test_the_same_input_gives_the_same_bytes(int8: Path, tmp_path: Path) -> None:
    assert contents(write(tmp_path / "again", lowered())) == contents(int8)


def test_the_identity_tells_the_precision_and_a_calibration_belongs_to_both(int8: Path, tmp_path: Path) -> None:
    plain, both = read_manifest(write(tmp_path / "fp32", None)), read_manifest(int8)
    other = read_manifest(write(tmp_path / "other", lowered(seed=1)))
    assert len({plain.identity, both.identity, other.identity}) == 3
    assert plain.model_identity == both.model_identity == other.model_identity
    asked = read_manifest(write(tmp_path / "asked", replace(lowered(), asked=("step",))))
    assert asked.identity == both.identity, "what was asked for is not what an artifact computes"


def test_blocks_are_opened_in_the_precision_of_the_plan(int8: Path) -> None:
    artifact = load_artifact(int8)
    assert artifact.manifest.precision is not None
    assert artifact.default is artifact.plans["full"]
    assert artifact.default.precision == {"blocks": "int8"} and artifact.plans["dense"].precision == {}
    x = np.random.default_rng(0).standard_normal((2, HORIZON, WIDTH)).astype(np.float32)
    feed = {"stream_0": x, "modulation": np.zeros((2, 1, WIDTH), np.float32)}
    results = []
    for view in (view_of(artifact), view_of(artifact, "dense"), view_of(artifact, "full@fp32")):
        options = onnxruntime.SessionOptions()
        options.add_session_config_entry("session.x64quantprecision", "1")  # sums do not saturate without VNNI either
        path = str(int8 / view.onnx_file("block_00"))
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        results.append(session.run(None, feed)[0])
        assert view.onnx_file("stem") == "stem.onnx"
    expected = x @ artifact.weights["block.0.weight"].T
    assert_equal_but_for_rounding(results[1], expected, terms=WIDTH)
    np.testing.assert_array_equal(results[1], results[2])
    assert 0 < np.linalg.norm(results[0] - expected) / np.linalg.norm(expected) < 0.02


def test_a_piece_of_the_prologue_has_a_model_of_its_own(tmp_path: Path) -> None:
    program = tiny_program()
    step, weights = quantize_model(tiny_models(program)["step"], program.weights)
    write_artifact(program, tiny_models(program), tmp_path / "a", LoweredPieces("int8", {"step": step}, weights))
    artifact = load_artifact(tmp_path / "a")
    record = artifact.manifest.precision
    assert record is not None and (record.kept, record.asked, record.blocks) == (("step",), (), 0)
    view, plain = view_of(artifact), view_of(artifact, "dense")
    assert (view.onnx_file("step"), view.onnx_file("block_00")) == ("step_int8.onnx", "block_00.onnx")
    assert plain.onnx_file("step") == "step.onnx"


def test_a_calibration_keeps_the_precision(int8: Path) -> None:
    before = read_manifest(int8)
    store_schedules(int8, None, {"uniform": uniform_plan(3, 2, 1)}, "uniform", {})
    after = load_artifact(int8).manifest
    assert after.precision == before.precision
    assert after.identity != before.identity


def test_an_int8_artifact_is_replaced_by_an_fp32_one(int8: Path, tmp_path: Path) -> None:
    write(int8, None)
    assert contents(int8) == contents(write(tmp_path / "fp32", None))


def test_constants_of_the_programs_names_and_models_of_other_interfaces_are_refused(tmp_path: Path) -> None:
    blocks = lowered()
    clash = replace(blocks, weights={**blocks.weights, "block.0.weight": np.zeros((2, 2), np.int8)})
    with pytest.raises(ArtifactError, match=r"new names; found 'block\.0\.weight'"):
        write(tmp_path / "a", clash)
    swapped = replace(blocks, models={"block_01": blocks.models["block_00"]})
    with pytest.raises(ArtifactError, match=r"'block_01' reads \['stream_0', 'modulation'\].*expected"):
        write(tmp_path / "b", swapped)
    with pytest.raises(ArtifactError, match="expected no such piece"):
        write(tmp_path / "c", replace(blocks, models={"block_07": blocks.models["block_00"]}))
    with pytest.raises(ArtifactError, match="has no data and is no constant"):
        write(tmp_path / "d", replace(blocks, weights={"unread": np.zeros(3, np.int8)}))
    assert list(tmp_path.iterdir()) == []


Change = Callable[[dict[str, Any]], object]


def decoded(manifest: Manifest, change: Change) -> Manifest:
    document = codec.to_json(manifest)
    change(document["precision"])
    return codec.from_json(Value(document, "manifest.json"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.update(name="int3"), "precision.name: expected one of 'int8', 'int4'"),
        (lambda p: p.update(name=8), "precision.name: expected a string"),
        (lambda p: p.update(weights="../weights"), "precision.weights: expected a plain file name"),
        (lambda p: p.update(weights="weights.safetensors"), "which nothing else uses"),
        (lambda p: p.update(weights="block_00_int8.onnx"), "which nothing else uses"),
        (
            lambda p: p.update(models={}),
            "models of some of block_00, block_01, blocks, condition, dense_step, step and",
        ),
        (lambda p: p["models"].pop("blocks"), "expected models called blocks and dense_step too"),
        (lambda p: p["models"].pop("dense_step"), "expected models called blocks and dense_step too"),
        (lambda p: p.update(models=[]), "precision.models: expected an object"),
        (lambda p: p["models"].update(stem="stem_int8.onnx"), "expected models of some of block_00"),
        (lambda p: p["models"].update(block_00="block_01_int8.onnx"), "which nothing else uses"),
        (lambda p: p["models"].update(block_00="/etc/passwd"), "models.block_00: expected a plain file name"),
        (lambda p: p["models"].update(block_00="advance.onnx"), "which nothing else uses"),
        (lambda p: p["models"].update(block_00="block_00_int9.onnx"), "files: expected exactly the files"),
        (lambda p: p["models"].pop("block_00"), "files: expected exactly the files"),
        (lambda p: p.update(models={"blocks": "blocks_int8.onnx"}), "models of some blocks beside blocks"),
        (lambda p: p.update(asked=["stem"]), "parts of the policy that none of its models belongs to"),
        (lambda p: p.update(asked=["blocks"]), "parts of the policy that none of its models belongs to"),
        (lambda p: p.update(asked={}), "precision.asked: expected a"),
        (lambda p: p.pop("asked"), "missing: ..asked"),
        (lambda p: p.update(fp32="weights_fp32.safetensors"), "files: expected exactly the files"),
        (lambda p: p.update(fp32="weights.safetensors"), "which nothing else uses"),
        (lambda p: p.update(fp32="../other"), "precision.fp32: expected a plain file name"),
        (lambda p: p.update(more=1), "unknown: ..more"),
    ],
)
def test_a_hostile_record_is_refused(int8: Path, change: Change, message: str) -> None:
    manifest = read_manifest(int8)
    assert decoded(manifest, lambda p: None).precision == manifest.precision
    with pytest.raises(ArtifactError, match=message):
        decoded(manifest, change)


def test_a_copy_may_lack_what_is_read_in_fp32_alone(
    int8: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bind, "LEAST_APART", 0)
    whole, copy = write(tmp_path / "whole", lowered()), tmp_path / "copy"
    apart = {"block.0.weight", "block.1.weight"}
    assert set(tensors.read(whole / "weights_fp32.safetensors")) == apart
    two, one = read_manifest(whole), read_manifest(int8)
    assert two.model_identity != one.model_identity, "its models name another file"
    other = replace(two, files={**two.files, "weights_fp32.safetensors": two.files["weights.safetensors"]})
    assert identities(other)[0] != two.identity and identities(other)[1] != two.model_identity
    for name, value in load_artifact(int8).weights.items():
        np.testing.assert_array_equal(load_artifact(whole).weights[name], value)
    shutil.copytree(whole, copy, ignore=shutil.ignore_patterns("weights_fp32.safetensors"))
    artifact, full = load_artifact(copy), load_artifact(whole)
    assert (artifact.without, full.without) == ("weights_fp32.safetensors", None)
    assert artifact.manifest.identity == full.manifest.identity and artifact.bytes < full.bytes
    assert set(full.weights) - set(artifact.weights) == apart
    zipped = load_artifact(packed(whole, skip="weights_fp32.safetensors"))
    assert zipped.without == "weights_fp32.safetensors"
    flip(copy / "weights.safetensors", (copy / "weights.safetensors").stat().st_size - 1)
    with pytest.raises(ArtifactError, match="weights.safetensors: expected sha256"):
        load_artifact(copy)


def test_a_copy_without_fp32_computes_what_the_whole_does_and_refuses_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bind, "LEAST_APART", 0)
    whole, copy = write(tmp_path / "whole", lowered()), tmp_path / "copy"
    shutil.copytree(whole, copy, ignore=shutil.ignore_patterns("weights_fp32.safetensors"))
    one, other = ttscompile.load(whole), ttscompile.load(copy)
    ((obs, noise),) = random_calls(read_manifest(whole).spec, 1, seed=0)
    expected = one.predict_action(obs, noise=noise)["action_pred"]
    np.testing.assert_array_equal(other.predict_action(obs, noise=noise)["action_pred"], expected)
    for plan in ("dense", "full@fp32"):
        with pytest.raises(ArtifactError, match=r"expected weights_fp32\.safetensors.*'NAME@int8'"):
            other.predict_action(obs, noise=noise, plan=plan)
    with pytest.raises(ArtifactError, match=r"expected weights_fp32\.safetensors"):
        ttscompile.load(copy, "reference", plan="dense")
    with pytest.raises(ArtifactError, match=r"expected weights_fp32\.safetensors.* or copy that file too"):
        ttscompile.verify(copy)


def test_a_precision_of_null_is_refused(int8: Path) -> None:
    document = codec.to_json(read_manifest(int8)) | {"precision": None}
    with pytest.raises(ArtifactError, match="parts in the precision that the artifact has models in, none"):
        codec.from_json(Value(document, "manifest.json"))
    with pytest.raises(ArtifactError, match="files: expected exactly the files"):
        codec.from_json(Value({**document, "plans": {}, "default_plan": "dense"}, "manifest.json"))
