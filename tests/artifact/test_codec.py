import json
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tests.artifact.tiny import tiny_spec
from ttscompile.artifact import codec
from ttscompile.artifact.manifest import SCHEMA_VERSION, Manifest, PlanRecord
from ttscompile.artifact.strict_json import Value, dump, parse
from ttscompile.artifact.typed_json import from_json, read_as, to_json
from ttscompile.core.spec import Affine, Instruction, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.errors import ArtifactError, SpecError
from ttscompile.ir.graph import Batch, TensorType

finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


@pytest.fixture
def manifest(written: Path) -> Manifest:
    return codec.decode((written / "manifest.json").read_bytes())


def through_json(spec: PolicySpec) -> PolicySpec:
    return from_json(PolicySpec, parse(dump(to_json(spec)), "spec"))


@pytest.mark.slow
@given(st.lists(finite.filter(bool), min_size=1, max_size=8), st.data())
def test_float32_comes_back_bit_by_bit(scale: list[float], data: st.DataObject) -> None:
    n = len(scale)
    offset = data.draw(st.lists(finite, min_size=n, max_size=n))
    affine = Affine(np.array(scale, np.float32), np.array(offset, np.float32))
    triples = st.lists(finite, min_size=3, max_size=3).map(lambda values: np.array(values, np.float32))
    columns: dict[str, Any] = {name: data.draw(triples) for name in SamplerTable.COLUMNS}
    timesteps = data.draw(triples)
    base = tiny_spec()
    clip = data.draw(st.none() | st.floats(0, 1e9, exclude_min=True))
    sampler = replace(base.sampler, timesteps=timesteps, clip=clip, **columns)
    spec = replace(base, sampler=sampler, observations={"obs": ObservationSpec((n,), affine)})
    found = through_json(spec)
    normalizer = found.observations["obs"].normalizer
    assert normalizer is not None
    assert normalizer.scale.tobytes() == affine.scale.tobytes()
    assert normalizer.offset.tobytes() == affine.offset.tobytes()
    assert found.sampler.timesteps.tobytes() == timesteps.tobytes()
    assert found.sampler.timesteps.dtype == np.float32
    assert found.sampler.clip == sampler.clip
    for name, column in columns.items():
        assert getattr(found.sampler, name).tobytes() == column.tobytes()


def test_spec_comes_back_with_its_order() -> None:
    spec = tiny_spec()
    found = through_json(spec)
    assert list(found.observations) == ["obs", "goal"]
    assert to_json(found) == to_json(spec)
    assert found.sampler.timesteps.dtype == np.int64


@pytest.mark.parametrize(
    "kind", [TensorType((Batch(), 16, 64), "float32"), TensorType((Batch(12), 0), "int64"), TensorType((), "bool")]
)
def test_types_come_back(kind: TensorType) -> None:
    assert from_json(TensorType, Value(to_json(kind), "t")) == kind


@pytest.mark.parametrize("size", ["b", "1*B", "0*B", "-2*B", "B*2", "", " B", -1, 1.5, None, True])
def test_sizes_that_are_none(size: object) -> None:
    with pytest.raises(ArtifactError, match=r"t\.shape\[1\]"):
        from_json(TensorType, Value({"dtype": "float32", "shape": ["B", size]}, "t"))


def test_what_a_record_leaves_out_has_its_default() -> None:
    """Manifests of policies without it are as they were before there was such a field."""
    spec, instruction = tiny_spec(), Instruction("obs", "obs", False)
    assert "noise" not in to_json(spec)
    assert to_json(instruction) == {"tokens": "obs", "mask": "obs", "new_line": False}
    uniform = replace(spec, noise="uniform", instruction=replace(instruction, before=("a line",), skipped=3))
    found = through_json(uniform)
    assert (found.noise, found.instruction) == ("uniform", uniform.instruction)
    with pytest.raises(SpecError, match="noise is 'pink'; expected normal or uniform"):
        replace(spec, noise="pink")  # type: ignore[arg-type]
    with pytest.raises(ArtifactError, match="noise"):
        from_json(PolicySpec, parse(dump({**to_json(spec), "noise": "pink"}), "spec"))


def test_manifest_comes_back(manifest: Manifest) -> None:
    content = codec.encode(manifest)
    again = codec.decode(content)
    assert codec.encode(again) == content
    assert again.pieces == manifest.pieces
    assert again.contexts == manifest.contexts
    assert again.blocks == manifest.blocks
    assert again.flops == manifest.flops
    assert again.files == manifest.files


@pytest.mark.slow
def test_every_flipped_bit_of_a_value_is_found(written: Path) -> None:
    """White space may change; whatever is read may not."""
    content = (written / "manifest.json").read_bytes()
    expected = json.loads(content)
    for position in range(0, len(content), 3):
        for bit in (0, 3, 6):
            changed = bytearray(content)
            changed[position] ^= 1 << bit
            try:
                same = json.loads(changed) == expected
            except ValueError:
                same = False
            if not same:
                with pytest.raises(ArtifactError):
                    codec.decode(bytes(changed))


def test_every_truncation_is_found(written: Path) -> None:
    content = (written / "manifest.json").read_bytes()
    for size in range(len(content) - 1):  # the last byte is a newline
        with pytest.raises(ArtifactError):
            codec.decode(content[:size])


Change = Callable[[dict[str, Any]], object]


def change(manifest: Manifest, edit: Change) -> bytes:
    """A manifest whose checksum is right and whose content is not."""
    document = codec.to_json(manifest)
    edit(document)
    return dump({**document, "checksum": codec._checksum(document)})


def plan(kind: str, **fields: Any) -> dict[str, Any]:
    """A plan as it stands in a manifest."""
    plain: dict[str, Any] = to_json(PlanRecord("all"))
    return {**plain, "kind": kind, **fields}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("spec"), r"missing: \['spec'\]"),
        (lambda d: d.update(more=1), r"unknown: \['more'\]"),
        (lambda d: d["spec"]["sampler"]["out_to_x0"].pop(), "spec.sampler: sampler column out_to_x0 must hold 3"),
        (lambda d: d["spec"]["sampler"]["out_to_x0"].__setitem__(1, 0.1), r"out_to_x0\[1\]: .*float32 holds exactly"),
        (lambda d: d["spec"]["sampler"]["out_to_x0"].__setitem__(1, 1e300), r"out_to_x0\[1\]: .*float32"),
        (lambda d: d["spec"]["chunk"].update(stop=99), "does not fit a sample"),
        (lambda d: d["spec"].update(sample=[1, 2, 3]), r"spec\.sample: expected a list of 2"),
        (lambda d: d["spec"]["observations"].clear(), "at least one observation"),
        (lambda d: d["spec"]["observations"]["obs"].update(dtype="object"), r"observations\.obs\.dtype"),
        (lambda d: d["spec"]["observations"]["obs"]["normalizer"]["scale"].__setitem__(0, 0), "scale is zero"),
        (lambda d: d["blocks"].pop(), "expected FLOPs of 1 blocks"),
        (lambda d: d["blocks"][1].update(flops=-1), r"blocks\[1\]\.flops"),
        (lambda d: d["pieces"].pop("advance"), "'advance'"),
        (lambda d: d["pieces"].pop("block_01"), "'block_01'"),
        (lambda d: d["pieces"].pop("pruner"), "exactly when there is a piece called pruner"),
        (lambda d: d["pieces"]["stem"].update(file="../stem.onnx"), "plain file name"),
        (lambda d: d["pieces"]["stem"].update(stream="no"), r"pieces\.stem\.stream: expected one of"),
        (lambda d: d["pieces"]["stem"].update(contexts=["no"]), "contexts of stem"),
        (lambda d: d["pieces"]["stem"].update(file="other.onnx"), "exactly the files"),
        (lambda d: d["contexts"]["memory"].update(binding="loop"), r"contexts\.memory\.binding"),
        (lambda d: d["files"].update({"../../etc/passwd": d["files"]["stem.onnx"]}), "plain file name"),
        (lambda d: d["files"].update({"manifest.json": d["files"]["stem.onnx"]}), "plain file name"),
        (lambda d: d["files"]["stem.onnx"].update(sha256="ab"), "64 hexadecimal"),
        (lambda d: d.update(identity="A" * 64), "64 hexadecimal"),
        (lambda d: d.update(default_plan="none"), r"default_plan: expected one of \['dense'\]"),
        (lambda d: d["plans"].update(s=plan("schedule")), "file of plans"),
        (lambda d: d["plans"].update(s=plan("all", loop="ddim-2")), r"a loop, one of \['original'\]"),
        (lambda d: d["plans"].update(s=plan("all", weights="mine")), r"weights, one of \['original'\]"),
        (
            lambda d: d["plans"].update(s=plan("all", precision={"blocks": "int8"})),
            "parts in the precision that the artifact",
        ),
        (lambda d: d["plans"].update(s=plan("all", otherwise="dense")), "exactly where the loop begins with one"),
        (lambda d: d["starts"].update(s={"loop": "original", "steps": 3}), "fewer steps than the 3 of loop"),
        (lambda d: d["starts"].update(original={"loop": "original", "steps": 2}), "another name than the loops"),
        (lambda d: d["plans"].update(s=plan("pruner", sparsity=1.01)), r"0\.\.1"),
        (lambda d: d["plans"].update(s=plan("pruner", sparsity=-0.01)), r"0\.\.1"),
        (lambda d: d["plans"].update(s=plan("magic")), "'schedule'"),
        (lambda d: d["plans"].update(dense=plan("pruner")), "called 'dense'"),
        (lambda d: d["requires"].update(onnxruntime="latest"), "a version like"),
        (lambda d: d["requires"].update(opset=0), "at least 1"),
        (lambda d: d.update(calibration=[]), "calibration: expected an object"),
        (lambda d: d.update(features=["memory", "none"]), r"features: expected some of the contexts \['memory', "),
    ],
)
def test_contents_that_are_refused(manifest: Manifest, edit: Change, message: str) -> None:
    with pytest.raises(ArtifactError, match=message):
        codec.decode(change(manifest, edit))


@pytest.mark.parametrize("version", [0, 1, 2, 3, 99, "2", 2.0, True, None])
def test_another_schema_version_says_what_to_do(manifest: Manifest, version: object) -> None:
    content = change(manifest, lambda d: d.update(schema_version=version, ttscompile_version="7.8.9"))
    told = (
        r"which this ttscompile reads; found .*Convert the checkpoint again .* install ttscompile==7\.8\.9, which wrote"
    )
    with pytest.raises(ArtifactError, match=told):
        codec.decode(content)


def test_a_future_schema_is_named_before_anything_else_is_read() -> None:
    content = dump({"format": "ttscompile artifact", "schema_version": SCHEMA_VERSION + 1, "new": "thing"})
    expected = f"schema_version: expected {SCHEMA_VERSION} or the one before, .*; found {SCHEMA_VERSION + 1}"
    with pytest.raises(ArtifactError, match=expected):
        codec.decode(content)


@pytest.mark.parametrize("content", [b"{}", b'{"format": "onnx"}', b"[]", b"1", b'{"schema_version": 1}'])
def test_other_documents(content: bytes) -> None:
    with pytest.raises(ArtifactError, match="manifest"):
        codec.decode(content)


def test_arrays_are_read_where_numpy_has_a_type_statement_for_them() -> None:
    """numpy 2.5 on Python 3.12: the origin of ``NDArray[float32]`` is the alias, which knows what it stands for."""

    class Alias:
        __value__ = np.ndarray[Any, Any]

    kind = types.GenericAlias(Alias, (np.float32,))  # as Python 3.12 makes one
    found = read_as(kind | None, Value([1.0, 2.0], "a"))
    assert found.dtype == np.float32 and found.tolist() == [1.0, 2.0]
    assert read_as(kind | None, Value(None, "a")) is None


def test_an_array_without_numbers_may_still_have_too_large_a_shape() -> None:
    """numpy has none of these sizes. Found by fuzzing."""
    empty = {"dtype": "int64", "shape": [0, 2**62, 4], "values": []}
    with pytest.raises(ArtifactError, match=r"a\.shape: expected sizes that an array can have"):
        read_as(np.ndarray[Any, np.dtype[np.int64]], Value(empty, "a"))
    assert read_as(np.ndarray[Any, np.dtype[np.int64]], Value({**empty, "shape": [0, 2]}, "a")).shape == (0, 2)
