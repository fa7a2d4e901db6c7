import os
import shutil
import tomllib
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from tests.artifact.folders import contents, failing
from tests.artifact.tiny import STEPS, tiny_models, tiny_program, write_tiny
from tests.plans import store_schedules
from ttscompile.artifact import Artifact, load_artifact, write
from ttscompile.artifact.files import locked
from ttscompile.artifact.write import write_artifact
from ttscompile.core.correction import condition_flops
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import ArtifactError, PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Node, TensorType
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Binding, Program, mapped

ROOT = Path(__file__).resolve().parents[2]


def without_sources(graph: Graph) -> Graph:
    return replace(graph, nodes=tuple(replace(node, source="") for node in graph.nodes))


def test_round_trip(written: Path) -> None:
    program = tiny_program()
    pieces = program.pieces
    artifact = load_artifact(written)
    manifest = artifact.manifest
    assert (manifest.steps, manifest.groups, manifest.default_plan, manifest.calibration) == (3, (0, 0), "dense", None)
    assert manifest.plans == {}
    assert manifest.flops.dense == 123_456
    assert manifest.flops.blocks == (2 * 4 * 16 * 16,) * 2
    read = condition_flops(STEPS, manifest.spec.sample, manifest.condition_numbers)
    assert manifest.condition_numbers > 0
    assert manifest.flops.prologue == 2 * 2 * 16 + STEPS * 2 * 16 * 16 + read
    assert {name: c.binding for name, c in manifest.contexts.items()} == pieces.bindings
    np.testing.assert_array_equal(artifact.plans["dense"].cells, [[0, 0]] * 3)
    for name, table in pieces.tables.items():
        assert artifact.tables[name].tobytes() == table.tobytes()
    stored = {**artifact.weights, **artifact.pruner}
    assert set(stored) == set(program.weights) - {"dead.weight"}
    for name, value in stored.items():
        assert value.tobytes() == program.weights[name].tobytes()
    assert all(name.startswith("pruner.") for name in artifact.pruner)
    found, expected = artifact.pieces, mapped(pieces, without_sources)
    for name, graph in expected.graphs().items():
        assert artifact.graph(name) == graph
    for name in ("condition", "step", "stem", "tail", "pruner"):
        assert getattr(found, name) == getattr(expected, name)
    assert found.blocks == expected.blocks
    assert found.bindings == pieces.bindings
    assert [b.group for b in manifest.blocks] == [0, 0]


def test_flops_of_a_call(written: Path) -> None:
    flops = load_artifact(written).manifest.flops
    plan = np.array([[0, 0], [1, 2], [0, 3]], np.int8)
    fixed = flops.prologue + 3 * (flops.stem + flops.tail)
    assert flops.call(plan, pruned=False) == fixed + 3 * 2048
    assert flops.call(plan, pruned=True) == fixed + 3 * 2048 + flops.pruner


def test_nothing_of_the_machine_is_written(written: Path) -> None:
    for name, content in contents(written).items():
        assert b"someone" not in content, name
        assert str(written.parent).encode() not in content, name


def run(artifact: Artifact, piece: str, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    import onnxruntime

    model = artifact.path / artifact.manifest.pieces[piece].file
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return [np.asarray(output) for output in session.run(None, inputs)]


def random_inputs(types: dict[str, Any], streams: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {name: rng.standard_normal(kind.at(streams)).astype(np.float32) for name, kind in types.items()}


@pytest.mark.parametrize("streams", [1, 3])
def test_onnxruntime_reads_the_weights_from_the_safetensors_files(written: Path, streams: int) -> None:
    import torch

    from tests.rounding import Counted, assert_equal_but_for_rounding

    artifact = load_artifact(written)
    weights = {n: torch.from_numpy(np.array(v)) for n, v in {**artifact.weights, **artifact.pruner}.items()}
    for piece in ("condition", "step", "stem", "block_00", "block_01", "pruner"):
        graph = artifact.graph(piece)
        inputs = random_inputs(dict(graph.inputs), streams)
        (found,) = run(artifact, piece, inputs)
        with Counted() as counted:
            expected = evaluate(graph, weights, {name: torch.from_numpy(value) for name, value in inputs.items()})
        assert_equal_but_for_rounding(found, expected[0], counted.terms)


def test_the_models_hold_references_and_not_the_weights(written: Path) -> None:
    artifact = load_artifact(written)
    model = onnx.load(artifact.path / artifact.manifest.pieces["pruner"].file, load_external_data=False)
    tensors = {tensor.name: tensor for tensor in model.graph.initializer}
    where = {entry.key: entry.value for entry in tensors["pruner.weight"].external_data}
    assert where["location"] == artifact.manifest.stores.pruner
    raw = (written / where["location"]).read_bytes()
    start = int(where["offset"])
    assert raw[start : start + int(where["length"])] == artifact.pruner["pruner.weight"].tobytes()
    assert not tensors["pruner.weight"].raw_data
    # Shape inference reads this one, and cannot do so from another file.
    assert np.frombuffer(tensors["pruner.shape"].raw_data, np.int64).tolist() == [-1, STEPS, 2, 4]


def test_a_session_follows_the_file_and_not_a_copy(written: Path) -> None:
    artifact = load_artifact(written)
    inputs = random_inputs(dict(artifact.graph("block_00").inputs), 1)
    assert run(artifact, "block_00", inputs)[0].any()
    path = written / "weights.safetensors"
    content, old = path.read_bytes(), artifact.weights["block.0.weight"].tobytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, bytes(len(old))))
    assert not run(artifact, "block_00", inputs)[0].any()


def test_the_same_inputs_give_the_same_bytes(written: Path, tmp_path: Path) -> None:
    program = tiny_program()
    models = tiny_models(program)
    shuffled = replace(program, weights=dict(reversed([*program.weights.items()])))
    write_artifact(shuffled, dict(reversed(models.items())), tmp_path / "elsewhere" / "again")
    assert contents(tmp_path / "elsewhere" / "again") == contents(written)


def test_models_are_not_changed_by_writing(tmp_path: Path) -> None:
    program = tiny_program()
    models = tiny_models(program)
    before = {name: model.SerializeToString(deterministic=True) for name, model in models.items()}
    write_artifact(program, models, tmp_path / "a")
    assert {name: model.SerializeToString(deterministic=True) for name, model in models.items()} == before


def identity_of(program: Program, folder: Path) -> tuple[str, str]:
    manifest = write_tiny(folder, program)
    return manifest.identity, manifest.model_identity


def test_identity_covers_what_is_computed(tmp_path: Path) -> None:
    program = tiny_program()
    base = identity_of(program, tmp_path / "base")
    spec = program.spec
    weight = {**program.weights, "tail.weight": program.weights["tail.weight"] * 2}
    pruner = {**program.weights, "pruner.bias": program.weights["pruner.bias"] + 1}
    table = replace(program.pieces, tables={**program.pieces.tables, "time": program.pieces.tables["time"] + 1})
    stem = program.pieces.stem.graph
    node = Node("stream_0", "aten.sub.Tensor", stem.nodes[1].args, (), stem.nodes[1].types)
    graph = replace(program.pieces, stem=LoopPiece(replace(stem, nodes=(stem.nodes[0], node)), "sample"))
    obs = dict(spec.observations)
    changed = {
        "weights": replace(program, weights=weight),
        "tables": replace(program, pieces=table),
        "graphs": replace(program, pieces=graph),
        "sampler": replace(program, spec=replace(spec, sampler=replace(spec.sampler, clip=2.0))),
        "chunk": replace(program, spec=replace(spec, chunk=replace(spec.chunk, stop=4))),
        "observation order": replace(program, spec=replace(spec, observations=dict(reversed(obs.items())))),
        "normalizer": replace(
            program, spec=replace(spec, observations={**obs, "obs": replace(obs["obs"], normalizer=None)})
        ),
    }
    found = {name: identity_of(value, tmp_path / name) for name, value in changed.items()}
    assert len({base, *found.values()}) == len(found) + 1
    assert len({base[1], *(model for _, model in found.values())}) == len(found) + 1
    other_pruner = identity_of(replace(program, weights=pruner), tmp_path / "pruner")
    assert other_pruner[0] != base[0]
    assert other_pruner[1] == base[1]


def test_identity_does_not_cover_what_people_are_told(tmp_path: Path) -> None:
    program = tiny_program()
    told = replace(program, spec=replace(program.spec, source={"format": "else"}), dense_flops=1)
    assert identity_of(told, tmp_path / "a") == identity_of(program, tmp_path / "b" / "c")


def test_a_policy_without_pruner(tmp_path: Path) -> None:
    program = tiny_program()
    program = replace(program, pieces=replace(program.pieces, pruner=None, features=()))
    models = tiny_models(tiny_program())
    del models["pruner"]
    write_artifact(program, models, tmp_path / "a")
    artifact = load_artifact(tmp_path / "a")
    assert artifact.pruner == {}
    assert artifact.manifest.stores.pruner is None


def test_an_artifact_is_replaced_whole(written: Path) -> None:
    (written / "pruner-00.onnx").write_bytes(b"left over")
    program = tiny_program(seed=1)
    manifest = write_tiny(written, program)
    assert load_artifact(written).manifest.identity == manifest.identity
    assert set(contents(written)) == {"manifest.json", *manifest.files}
    assert [path.name for path in written.parent.iterdir()] == [written.name]


def test_a_damaged_artifact_may_be_replaced(written: Path) -> None:
    (written / "weights.safetensors").unlink()
    write_tiny(written)
    load_artifact(written)


def test_through_a_link_the_artifact_is_replaced_and_not_the_link(written: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(written)
    program = tiny_program(seed=1)
    write_tiny(link, program)
    assert link.is_symlink()
    np.testing.assert_array_equal(load_artifact(written).weights["tail.weight"], program.weights["tail.weight"])


def test_an_empty_directory_is_taken(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    write_tiny(tmp_path / "empty")
    load_artifact(tmp_path / "empty")


def test_who_works_in_the_folder_works_in_the_new_one(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(written)
    manifest = write_tiny(Path(), tiny_program(seed=1))
    assert load_artifact(Path()).manifest.identity == manifest.identity
    assert Path.cwd() == written and contents(Path()) == contents(written)


def test_plans_that_are_lost_are_told_of(written: Path) -> None:
    kept = {"schedule": uniform_plan(3, 2, 1), "uniform": uniform_plan(3, 2, 1)}
    store_schedules(written, None, kept, "schedule", {"seed": 1})
    with pytest.warns(UserWarning, match=r"had 2 learned plans \(schedule, uniform\); the new one has none"):
        write_tiny(written)
    write_tiny(written)  # of what was not calibrated there is nothing to tell


@pytest.mark.parametrize("case", ["an artifact that is changed", "an artifact", "notes", "notes in the artifact"])
def test_what_comes_while_an_artifact_is_written(written: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """Nobody had locked the place, since there was nothing; and who has an artifact locked may put more into it."""
    target = written if case == "notes in the artifact" else written.parent / "new"

    def fill(*arguments: Any) -> Any:
        if case.startswith("an artifact"):
            shutil.copytree(written, target)
        else:
            target.mkdir(exist_ok=True)
            (target / "notes.txt").write_text("mine")
        if case == "an artifact that is changed":
            held.enter_context(locked(target))
        return own(*arguments)

    own, program = write._fill, tiny_program(seed=1)
    monkeypatch.setattr(write, "_fill", fill)
    with ExitStack() as held:
        if case == "an artifact":
            write_artifact(program, tiny_models(program), target)
            assert contents(target) != contents(written)
            return
        with pytest.raises(ArtifactError, match="is changing the artifact" if "changed" in case else r"notes\.txt"):
            write_artifact(program, tiny_models(program), target)
    assert contents(target).keys() - contents(written).keys() <= {"notes.txt"}
    assert [path.name for path in written.parent.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize("case", ["file", "notes", "notes in an artifact", "subfolder", "other manifest"])
def test_what_is_no_artifact_is_left_alone(written: Path, case: str) -> None:
    target = written
    if case == "file":
        target = written / "program.json"
    elif case == "notes":
        target = written.parent / "mine"
        target.mkdir()
        (target / "notes.txt").write_text("mine")
    elif case == "notes in an artifact":
        (written / "notes.txt").write_text("mine")
    elif case == "subfolder":
        (written / "runs").mkdir()
    else:
        (written / "manifest.json").write_text('{"name": "a web application"}')
    before = {p: p.read_bytes() for p in written.parent.rglob("*") if p.is_file()}
    with pytest.raises(ArtifactError, match="Give another output directory"):
        write_tiny(target)
    assert {p: p.read_bytes() for p in written.parent.rglob("*") if p.is_file()} == before


class Interrupted(BaseException):
    """As a Ctrl-C: no Exception."""


@pytest.mark.slow
@pytest.mark.parametrize("error", [Interrupted, OSError])
@pytest.mark.parametrize("function", ["replace", "fsync", "mkdir"])
@pytest.mark.parametrize("existing", [True, False])
def test_failure_anywhere_changes_nothing(
    written: Path, monkeypatch: pytest.MonkeyPatch, function: str, existing: bool, error: type[BaseException]
) -> None:
    target = written if existing else written.parent / "new"
    program = tiny_program(seed=1)
    models = tiny_models(program)
    before = contents(written)
    original = getattr(os, function)
    failed = 0
    first = 1 if function == "mkdir" else 0  # the parent is there, and its mkdir may fail
    for fail_at in range(first, 100):
        with monkeypatch.context() as patch:
            patch.setattr(os, function, failing(original, fail_at, error))
            try:
                write_artifact(program, models, target)
            except (Interrupted, ArtifactError):
                failed += 1
            else:
                break
        # Only waiting for the parent folder comes after the artifact is in its place.
        if contents(written) != before or (not existing and target.exists()):
            assert function == "fsync"
            assert {path.name for path in written.parent.iterdir()} == {"compiled", target.name}
            break
        assert {path.name for path in written.parent.iterdir()} <= {"compiled"}
    assert failed >= {"replace": 1 - existing, "fsync": 10, "mkdir": 1}[function]
    load_artifact(target)


def broken(program: Program, **pieces: Any) -> Program:
    return replace(program, pieces=replace(program.pieces, **pieces))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda p: replace(p, weights={}), "constant %.* has no value"),
        (
            lambda p: replace(p, weights={**p.weights, "tail.weight": np.zeros((2, 16))}),
            r"constant %tail.weight is float64\[2, 16\]",
        ),
        (lambda p: replace(p, blocks=p.blocks[:1]), "2 block graphs for 1 rows"),
        (lambda p: broken(p, bindings={}), "nothing provides its context %position"),
        (lambda p: broken(p, bindings={**p.pieces.bindings, "memory": Binding.STEP}), "provides its context %memory"),
        (lambda p: broken(p, bindings={**p.pieces.bindings, "memory": Binding.LOOP}), "provides its context %memory"),
        (lambda p: broken(p, tables={**p.pieces.tables, "time": np.zeros((2, 1, 1, 16), np.float32)}), "%time"),
        (lambda p: broken(p, step=None), "nothing provides its context %modulation"),
        (
            lambda p: broken(p, pruner=replace(p.pieces.pruner, inputs={"memory": TensorType((), "bool")})),
            "%memory is bool",
        ),
    ],
)
def test_programs_that_do_not_fit(tmp_path: Path, edit: Any, message: str) -> None:
    models = tiny_models(tiny_program())
    with pytest.raises(PassError, match=message):
        write_artifact(edit(tiny_program()), models, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda m: m.pop("advance"), "expected the ONNX models"),
        (lambda m: m.update(tail=m["stem"]), "expected the ONNX models"),
        (lambda m: setattr(m["pruner"].graph.output[0], "name", "plan"), r"\['plan'\]"),
        (lambda m: m["pruner"].graph.initializer.add(name="unknown", data_type=1, dims=[3]), "'unknown' has no data"),
        (lambda m: m["pruner"].graph.initializer[0].dims.__setitem__(0, 7), "initializer 'pruner.weight' is float32"),
        (lambda m: setattr(m["pruner"].opset_import[0], "version", 99), "opset 99"),
        (lambda m: setattr(m["pruner"], "ir_version", 99), "IR version 99"),
    ],
)
def test_models_that_do_not_fit(tmp_path: Path, edit: Any, message: str) -> None:
    program = tiny_program()
    models = tiny_models(program)
    edit(models)
    with pytest.raises(ArtifactError, match=message):
        write_artifact(program, models, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_an_embedded_value_is_left_as_it_is(tmp_path: Path) -> None:
    write_tiny(tmp_path / "a")
    saved = onnx.load(tmp_path / "a" / "advance.onnx", load_external_data=False)
    values = {t.name: onnx.numpy_helper.to_array(t) for t in saved.graph.initializer if t.name in ("low", "high")}
    assert values == {"low": -1, "high": 1}


def test_the_package_asks_for_the_onnxruntime_that_artifacts_need(written: Path) -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        dependencies = tomllib.load(file)["project"]["dependencies"]
    assert f"onnxruntime>={load_artifact(written).manifest.requires.onnxruntime}" in dependencies
