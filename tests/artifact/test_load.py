import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from tests.artifact.folders import flip
from tests.artifact.tiny import tiny_models, tiny_program
from tests.plans import store_schedules
from ttscompile.artifact import codec, load_artifact, tensors
from ttscompile.artifact.codec import identities
from ttscompile.artifact.files import describe
from ttscompile.artifact.strict_json import dump
from ttscompile.artifact.write import write_artifact
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.ir.graph import TensorType


def test_a_path_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="does not exist. Give the directory that 'ttscompile build' wrote"):
        load_artifact(tmp_path / "none")


def test_a_directory_that_is_no_artifact(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="not an artifact: it has no manifest.json"):
        load_artifact(tmp_path)


def test_a_manifest_that_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").mkdir()
    with pytest.raises(ArtifactError, match="cannot be read"):
        load_artifact(tmp_path)


FILES = sorted(["program.json", "weights.safetensors", "pruner", "plans", "pruner.onnx", "stem.onnx", "advance.onnx"])


def named(directory: Path, role: str) -> Path:
    manifest = codec.decode((directory / "manifest.json").read_bytes())
    name = {
        "pruner": manifest.stores.pruner,
        "plans": manifest.stores.plans,
        "pruner.onnx": manifest.pieces["pruner"].file,
    }
    return directory / (name.get(role) or role)


@pytest.fixture
def calibrated(written: Path) -> Path:
    plan = np.array([[0, 0], [2, 1], [3, 0]], np.int8)
    store_schedules(written, load_artifact(written).pruner, {"mine": plan}, "tts", {})
    return written


@pytest.mark.parametrize("role", FILES)
def test_a_file_that_is_missing_longer_or_a_folder(calibrated: Path, role: str) -> None:
    path = named(calibrated, role)
    with path.open("ab") as file:
        file.write(b"\0")
    with pytest.raises(ArtifactError, match="longer than it was"):
        load_artifact(calibrated)
    path.unlink()
    with pytest.raises(ArtifactError, match="the file is missing; manifest.json lists it"):
        load_artifact(calibrated)
    path.mkdir()
    with pytest.raises(ArtifactError, match="expected a file"):
        load_artifact(calibrated)


@pytest.mark.parametrize("role", FILES)
def test_a_truncated_file(calibrated: Path, role: str) -> None:
    path = named(calibrated, role)
    content = path.read_bytes()
    for size in (0, 1, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(ArtifactError, match="the file is truncated"):
            load_artifact(calibrated)


@pytest.mark.slow
@pytest.mark.parametrize("role", FILES)
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_any_flipped_bit_of_any_file(calibrated: Path, role: str, where: float, bit: int) -> None:
    path = named(calibrated, role)
    content = path.read_bytes()
    flip(path, int(where * len(content)), bit)
    with pytest.raises(ArtifactError, match="the file was changed since it was written"):
        load_artifact(calibrated)
    path.write_bytes(content)
    load_artifact(calibrated)


def forge(directory: Path, file: Path | None = None, **changes: Any) -> None:
    """Change the manifest and make its checksum, and the hash of a changed file, right."""
    document = json.loads((directory / "manifest.json").read_bytes())
    document.update(changes)
    document.pop("checksum")
    if file is not None:
        document["files"][file.name] = vars(describe(file))
    content = dump({**document, "checksum": codec._checksum(document)})
    (directory / "manifest.json").write_bytes(content)


def test_a_changed_weight_with_a_right_hash_has_another_identity(written: Path) -> None:
    path = written / "weights.safetensors"
    flip(path, path.stat().st_size - 1)
    forge(written, path)
    with pytest.raises(ArtifactError, match="expected the identity"):
        load_artifact(written)


def test_another_default_plan_has_another_identity(calibrated: Path) -> None:
    forge(calibrated, default_plan="dense")
    with pytest.raises(ArtifactError, match="expected the identity"):
        load_artifact(calibrated)


@pytest.mark.parametrize(
    ("installed", "good"),
    [("1.22.9", False), ("1.23", True), ("1.23.0", True), ("1.9", False), ("1.23.0.dev1+cpu", True), ("2.0", True)],
)
def test_version_of_onnxruntime(written: Path, monkeypatch: pytest.MonkeyPatch, installed: str, good: bool) -> None:
    monkeypatch.setattr("onnxruntime.__version__", installed)
    if good:
        load_artifact(written)
        return
    with pytest.raises(ArtifactError, match=r"opset 18.*need onnxruntime >= 1\.23; .*pip install 'onnxruntime>=1\.23'"):
        load_artifact(written)


def repair(directory: Path, changed: Path) -> None:
    """Make hash and identity right, so that only what is inside the file can be wrong."""
    forge(directory, changed)
    manifest = codec.decode((directory / "manifest.json").read_bytes())
    identity, model_identity = identities(manifest)
    forge(directory, identity=identity, model_identity=model_identity)


@pytest.mark.parametrize(
    ("plans", "message"),
    [
        ({}, r"expected schedules \['mine'\]"),
        ({"other": np.zeros((3, 2), np.int8)}, r"found \['other'\]"),
        ({"mine": np.zeros((2, 2), np.int8)}, "plan has shape"),
        ({"mine": np.zeros((3, 2), np.int16)}, "int16"),
        ({"mine": np.full((3, 2), 4, np.int8)}, r"holds values 4\.\.4"),
        ({"mine": np.ones((3, 2), np.int8)}, "expected COMPUTE in all of step 0"),
    ],
)
def test_schedules_that_do_not_fit(calibrated: Path, plans: dict[str, np.ndarray], message: str) -> None:
    path = named(calibrated, "plans")
    path.write_bytes(tensors.serialize(plans))
    repair(calibrated, path)
    with pytest.raises(ArtifactError, match=message):
        load_artifact(calibrated)


@pytest.mark.parametrize("table", [None, np.zeros((3, 1, 2, 16), np.float32), np.zeros((3, 1, 1, 16), np.float64)])
def test_tables_that_do_not_fit(written: Path, table: np.ndarray | None) -> None:
    path = written / "weights.safetensors"
    stored = {name: np.array(value) for name, value in tensors.read(path).items()}
    del stored["table/time"]
    path.write_bytes(tensors.serialize(stored if table is None else {**stored, "table/time": table}))
    repair(written, path)
    with pytest.raises(ArtifactError, match="expected (tables of|the table 'time')"):
        load_artifact(written)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["graphs"].pop("tail"), "has no graph 'tail'"),
        (lambda d: d.update(more=1), "unknown"),
        (lambda d: d["streams"].update(tail="elsewhere"), "program.json.streams.tail: .*stream_2.*elsewhere"),
        (lambda d: d["streams"].pop("stem"), "has no stream of 'stem'"),
        (lambda d: d["graphs"]["stem"]["nodes"][0].update(op="os.system"), r"graphs.stem.nodes\[0\].op: .*os.system"),
        (lambda d: d["graphs"]["stem"]["constants"][0].update(name="none"), "values computed before"),
        (lambda d: d["graphs"]["stem"]["constants"].append({"name": "x", "type": {"dtype": "float32", "shape": [1]}}),
         "expected the constant 'x' : .*found none"),
        (lambda d: d["graphs"]["stem"]["constants"][0]["type"].update(shape=[1]), r"found float32\[16, 2\]"),
    ],
)  # fmt: skip
def test_programs_that_do_not_fit(written: Path, edit: Any, message: str) -> None:
    path = written / "program.json"
    document = json.loads(path.read_bytes())
    edit(document)
    path.write_text(json.dumps(document))
    repair(written, path)
    artifact = load_artifact(written)  # graphs are for the reference runtime, and are decoded when it asks
    with pytest.raises(ArtifactError, match=message):
        _ = artifact.pieces


def test_files_that_nobody_declared_are_ignored(written: Path) -> None:
    (written / "README.txt").write_text("hello")
    load_artifact(written)


def test_loading_imports_no_compiler(written: Path) -> None:
    script = (
        "import sys\n"
        "from ttscompile.artifact import load_artifact\n"
        "artifact = load_artifact(sys.argv[1])\n"
        "artifact.graph('stem')\n"
        "found = {'torch', 'onnx', 'onnxscript', 'safetensors', 'pydantic', 'diffusers'} & set(sys.modules)\n"
        "sys.exit(str(found) if found else 0)\n"
    )
    subprocess.run([sys.executable, "-c", script, written], check=True)


def test_unknown_names_are_errors(written: Path) -> None:
    artifact = load_artifact(written)
    with pytest.raises(ArtifactError, match=r"no graph 'advance'; it has \['condition'"):
        artifact.graph("advance")
    for name in ("fast", "dense@fp8", "fast@fp32"):
        with pytest.raises(IllegalPlanError, match=rf"no plan '{name}'; it has \['dense'\]"):
            artifact.plan(name)


@pytest.mark.alone
def test_loading_forty_megabytes(tmp_path: Path, benchmark: Any) -> None:
    program = tiny_program()
    pieces = program.pieces
    constants = {**pieces.condition.constants, "large": TensorType((10_000_000,), "float32")}
    condition = replace(pieces.condition, constants=constants)
    weights = {**program.weights, "large": np.full(10_000_000, 1 / 3, np.float32)}
    program = replace(program, weights=weights, pieces=replace(pieces, condition=condition))
    write_artifact(program, tiny_models(tiny_program()), tmp_path / "a")
    artifact = benchmark.pedantic(load_artifact, args=(tmp_path / "a",), rounds=5)
    assert artifact.weights["large"].nbytes == 40_000_000
