"""Weights in 16 bits: where that changes no number, and the same answers, bit by bit, as with float32 on disk."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info
from safetensors.torch import load_file

import ttscompile
from ttscompile.artifact import load_artifact, tensors
from ttscompile.artifact.bind import bind, places_of, unbound
from ttscompile.artifact.short import LEAST_SHORT, short_code
from ttscompile.errors import ArtifactError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.runtimes.random_calls import random_calls

SHAPE = (64, LEAST_SHORT // 64)
ODD = np.array([0x7FC00000, 0xFF800000, 0x80000000, 0x00010000, 0x7F7F0000], np.uint32).view(np.float32)
"""As bfloat16 has them, too: not a number, minus infinity, minus zero, one that is not normal, the largest."""


def drawn(kind: torch.dtype) -> np.ndarray:
    """Normal numbers that a type of 16 bits has."""
    values = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    return values.to(kind).float().numpy()


def test_an_array_is_in_16_bits_where_each_of_its_numbers_is_exact() -> None:
    brain, half = drawn(torch.bfloat16), drawn(torch.float16)
    assert (short_code(brain), short_code(half)) == ("BF16", "F16")
    assert short_code(drawn(torch.float32)) is None
    for array in (brain, half):
        changed = array.copy()
        changed[-1, -1] = 1 + 2**-11
        assert short_code(changed) is None, "one of them is not"
    assert short_code(brain[:, 1:]) is None, "small ones stay as they are"
    assert short_code(brain.astype(np.float64)) is None


@pytest.mark.parametrize(
    ("values", "code"), [(ODD, "BF16"), (np.array([65504, 2**-24, -0.0, np.inf], np.float32), "F16")]
)
def test_what_is_hardly_a_number_keeps_its_bits(tmp_path: Path, values: np.ndarray, code: str) -> None:
    array = np.resize(values, SHAPE)
    tensors.write(tmp_path / "w.safetensors", {"a": array}, short=True)
    assert tensors.entries_of(tmp_path / "w.safetensors")["a"].code == code
    found = np.asarray(tensors.read(tmp_path / "w.safetensors", short=True)["a"])
    np.testing.assert_array_equal(found.view(np.uint32), array.view(np.uint32))


def test_what_float16_has_not_is_not_made_of_it() -> None:
    for value in (65536.0, 2.0**-25, np.uint32(0x7FC00001).view(np.float32)):
        assert short_code(np.full(SHAPE, value, np.float32) + drawn(torch.float16) * 0) != "F16"


def test_a_file_of_them_is_read_by_us_and_by_the_library(tmp_path: Path) -> None:
    path, brain, half = tmp_path / "w.safetensors", drawn(torch.bfloat16), drawn(torch.float16)
    few = np.zeros(3, np.float32)
    arrays = {"brain": brain.T, "half": half.astype(">f4"), "whole": drawn(torch.float32), "few": few}
    tensors.write(path, arrays, short=True)
    found, theirs, entries = tensors.read(path, short=True), load_file(path), tensors.entries_of(path)
    assert [entries[name].code for name in arrays] == ["BF16", "F16", "F32", "F32"]
    assert [entries[name].length for name in ("brain", "half", "whole")] == [2 * brain.size] * 2 + [4 * brain.size]
    for name, array in arrays.items():
        own = found[name]
        said = (str(own.dtype), own.shape, own.size, own.ndim, own.nbytes)
        assert said == ("float32", array.shape, array.size, array.ndim, array.nbytes)
        np.testing.assert_array_equal(np.asarray(own), array)
        np.testing.assert_array_equal(theirs[name].float().numpy(), array)
    assert np.asarray(found["half"], np.float64).dtype == np.float64
    with pytest.raises(ArtifactError, match=r"brain.dtype: expected one of 'BOOL'"):
        tensors.read(path)


def rounded(checkpoint: Path, target: Path) -> Path:
    """The checkpoint with weights that bfloat16 has."""
    payload = read_checkpoint(checkpoint)
    weights = {n: v.bfloat16().float() for n, v in payload["state_dicts"]["ema_model"].items()}
    torch.save({"cfg": payload["cfg"], "state_dicts": {"ema_model": weights}, "pickles": {}}, target)
    return target


@pytest.mark.slow
@pytest.mark.parametrize(("code", "precision"), [("F16", "fp32"), ("BF16", "fp32"), ("BF16", "int8")])
def test_answers_are_those_of_weights_in_float32(
    one_layer_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, precision: Any
) -> None:
    checkpoint = one_layer_checkpoint if code == "F16" else rounded(one_layer_checkpoint, tmp_path / "policy.ckpt")
    ttscompile.convert(checkpoint, tmp_path / "short", precision=precision)
    monkeypatch.setattr(tensors, "short_code", lambda _: None)
    ttscompile.convert(checkpoint, tmp_path / "long", precision=precision)
    short, long = (load_artifact(tmp_path / name) for name in ("short", "long"))
    codes = [one.code for one in tensors.entries_of(tmp_path / "short" / "weights.safetensors").values()]
    assert codes.count(code) >= 5 and code not in {
        one.code for one in tensors.entries_of(tmp_path / "long" / "weights.safetensors").values()
    }
    ((obs, noise),) = random_calls(short.manifest.spec, 1, seed=0)
    for runtime in ("onnxruntime", "torch", "reference") if precision == "fp32" else ("onnxruntime",):
        answers = [ttscompile.load(one.path, runtime=runtime).predict_action(obs, noise=noise) for one in (short, long)]
        np.testing.assert_array_equal(answers[0]["action_pred"], answers[1]["action_pred"], err_msg=runtime)
    if precision == "int8":
        found = {rung.name: rung.status for rung in ttscompile.verify(tmp_path / "short").rungs}
        assert {status for name, status in found.items() if name != "engaged"} <= {"passed", "skipped"}, found


def test_a_model_that_is_bound_again_reads_the_new_numbers(compiled_layer: Path, tmp_path: Path) -> None:
    artifact = load_artifact(compiled_layer)
    path = compiled_layer / artifact.manifest.pieces["block_02"].file
    model = onnx.load(path, load_external_data=False)
    (stored, *others) = [t.name for t in model.graph.initializer if t.data_type == onnx.TensorProto.FLOAT16]
    name = stored.removesuffix("/short")
    value = np.asarray(artifact.weights[name]) + np.float32(1e-4)
    tensors.write(tmp_path / "other.safetensors", {name: value}, short=True)
    again = onnx.load_from_string(
        bind(unbound(path, {name}), places_of(tmp_path / "other.safetensors", {name: value}), "block_02")
    )
    (own,) = [tensor for tensor in again.graph.initializer if tensor.name in (name, stored)]
    assert (own.name, own.data_type, own.external_data[0].value) == (name, onnx.TensorProto.FLOAT, "other.safetensors")
    casts = {node.output[0]: node for node in model.graph.node if node.name in (stored, *others)}
    left = [node for node in again.graph.node if node.op_type == "Cast"]
    assert left == [node for node in casts.values() if node.name != stored], "the others are as they were"


FLOAT, INT64, BOOL = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.BOOL


def gathering(**readers: str) -> onnx.ModelProto:
    """A model that gathers two rows of table ``t``, and reads it in other ways, too; each has an output."""
    gather, nodes = partial(make_node, "Gather", ["t", "i"]), list[onnx.NodeProto]()
    for name, kind in {"rows": "Gather", **readers}.items():
        if kind == "Gather":
            nodes.append(gather([name]))
        elif kind == "MatMul":
            nodes += [make_node("Transpose", ["rows"], ["turned"]), make_node("MatMul", ["t", "turned"], [name])]
        elif kind == "If":
            inner = [make_tensor_value_info("inner", FLOAT, None)]
            branch = make_graph([gather(["inner"])], "branch", [], inner)
            nodes.append(make_node("If", ["c"], [name], then_branch=branch, else_branch=branch))
    inputs = [make_tensor_value_info("i", INT64, [2]), make_tensor_value_info("c", BOOL, [])]
    outputs = [make_tensor_value_info(name, FLOAT, ["m", "n"]) for name in ("rows", *readers)]
    graph = make_graph(nodes, "g", inputs, outputs, [onnx.TensorProto(name="t", dims=SHAPE, data_type=FLOAT)])
    return make_model(graph, ir_version=10, opset_imports=[make_opsetid("", 20)])


@pytest.mark.parametrize(
    ("readers", "casts"),
    [
        ({}, ["rows"]),
        ({"again": "Gather"}, ["rows", "again"]),
        ({"product": "MatMul"}, ["t"]),
        ({"again": "If"}, ["t"]),
        ({"t": "output"}, ["t"]),
    ],
)
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_of_a_table_only_what_was_gathered_is_made_float32(
    tmp_path: Path, kind: torch.dtype, readers: dict[str, str], casts: list[str]
) -> None:
    table, rows = drawn(kind), np.array([3, 1])
    tensors.write(tmp_path / "w.safetensors", {"t": table}, short=True)
    bound = bind(gathering(**readers), places_of(tmp_path / "w.safetensors", {"t": table}), "piece")
    (tmp_path / "m.onnx").write_bytes(bound)
    nodes = onnx.load_from_string(bound).graph.node
    assert [node.output[0] for node in nodes if node.op_type == "Cast"] == casts
    session = onnxruntime.InferenceSession(tmp_path / "m.onnx", providers=["CPUExecutionProvider"])
    expected = {"rows": table[rows], "again": table[rows], "product": table @ table[rows].T, "t": table}
    found = session.run(None, {"i": rows, "c": np.array(True)})
    for name, array in zip(["rows", *readers], found, strict=True):
        np.testing.assert_allclose(array, expected[name], rtol=0, atol=1e-4 * (name == "product"), err_msg=name)
