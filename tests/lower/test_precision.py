"""``lower_precision``: integer products that are what they replace, within what eight bits allow."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch
from hypothesis import given, settings, strategies as st
from onnx import ModelProto, NodeProto, TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info
from torch.nn import functional

from tests.lower.modules import captured, random_values
from tests.lower.sessions import lower_graph, session
from tests.runtimes.toys import B, f32, node
from ttscompile.core.four_bits import unpack
from ttscompile.errors import LoweringError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Graph, Ref
from ttscompile.lower import precision as lowering
from ttscompile.lower.precision import LEAST_ROWS, lower_precision, quantize_matrix, quantize_model
from ttscompile.measure.machine import has_integer_dot_product

Array = npt.NDArray[Any]


def by_hand(nodes: list[NodeProto], weights: Mapping[str, Array], rows: int, columns: int) -> ModelProto:
    """A model from ``x [N, rows]`` to ``y [N, columns]``."""
    empty = [
        TensorProto(name=name, dims=value.shape, data_type=onnx.helper.np_dtype_to_tensor_dtype(value.dtype))
        for name, value in weights.items()
    ]
    ends = [make_tensor_value_info(n, TensorProto.FLOAT, ["N", size]) for n, size in (("x", rows), ("y", columns))]
    graph = make_graph(nodes, "g", ends[:1], ends[1:], empty)
    return make_model(graph, opset_imports=[make_opsetid("", 23)], ir_version=10)


def quantized_product(x: Array, matrix: Array) -> Array:
    """What the integer product should give, in float64: activations uint8 with one scale, weights as quantised."""
    low, high = min(0.0, float(x.min())), max(0.0, float(x.max()))
    scale = np.float32((np.float32(high) - np.float32(low)) / np.float32(255))
    zero = np.clip(np.rint(-low / scale), 0, 255)
    integers = np.clip(np.rint(x / scale) + zero, 0, 255)
    values, scales = quantize_matrix(matrix)
    product: Array = (integers - zero) @ values.astype(np.float64) * scale * scales
    return product


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.integers(-30, 30))
def test_a_matrix_is_within_half_a_step_of_its_column(rows: int, columns: int, seed: int, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = (rng.standard_normal((rows, columns)) * 10.0 ** rng.uniform(exponent - 3, exponent, columns)).astype("f4")
    matrix[:, rng.random(columns) < 0.2] = 0
    values, scales = quantize_matrix(matrix)
    assert values.dtype == np.int8 and scales.dtype == np.float32 and scales.shape == (columns,)
    assert values.min() >= -127 and np.isfinite(scales).all() and (scales > 0).all()
    assert (np.abs(values * scales.astype("f8") - matrix) <= 0.5001 * scales).all()
    used = np.abs(matrix).max(axis=0) > 0
    assert (np.abs(values).max(axis=0)[used] == 127).all(), "a column does not use its range"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SelfAttention", "CrossAttention", "FeedForward", "AdaptiveNorm", "SequenceFirst"])
def test_real_modules_stay_what_they_were(name: str) -> None:
    _, graph, tensors = captured(name)
    weights = {key: value.numpy() for key, value in tensors.items()}
    exact = lower_graph(graph, "block_00")
    model, constants = quantize_model(exact, weights)
    assert [v.name for v in model.graph.input] == [v.name for v in exact.graph.input]
    assert list(model.graph.output) == list(exact.graph.output)
    products = [node for node in model.graph.node if node.op_type == "DynamicQuantizeMatMul"]
    assert len(products) == sum(n.op_type == "Gemm" and n.input[1] in weights for n in exact.graph.node) > 0
    assert not any(tensor.raw_data for tensor in model.graph.initializer if tensor.name in constants)
    running = session(model, {**weights, **constants})
    for streams in (1, 2, 5):
        inputs = random_values(graph.inputs, streams)
        found = running.run(None, {key: value.numpy() for key, value in inputs.items()})[0]
        (expected,) = (value.numpy() for value in evaluate(graph, tensors, inputs))
        difference = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert 0 < difference < 0.02, "as float32, or further off than eight bits explain"


@pytest.mark.parametrize("rows", [1, 7, 256, 1024])
@pytest.mark.parametrize("bias", [True, False])
def test_the_product_is_exactly_the_quantised_one(rows: int, bias: bool) -> None:
    """A wrong scale, a swapped axis or a saturated sum is far beyond this tolerance, which is rounding of float32."""
    rng = np.random.default_rng(rows)
    weights = {"w": (rng.standard_normal((24, rows)) * 10.0 ** rng.uniform(-2, 2, (24, 1))).astype(np.float32)}
    if bias:
        weights["b"] = rng.standard_normal(24).astype(np.float32)
    model = by_hand([make_node("Gemm", ["x", *weights], ["y"], transB=1)], weights, rows, 24)
    x = (rng.standard_normal((16, rows)) + 0.7).astype(np.float32)
    quantised, constants = quantize_model(model, weights)
    found = session(quantised, {**weights, **constants}).run(None, {"x": x})[0]
    expected = quantized_product(x, weights["w"].T) + weights.get("b", 0)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("exact", [True, False])
def test_nothing_saturates(exact: bool) -> None:
    """The largest sums there are: sixteen bits hold 32767, and two of these products are 64770."""
    if not exact and not has_integer_dot_product():
        pytest.skip("this processor has no integer dot product: runtimes do not use it without the exact sums")
    weights = {"w": np.full((1024, 32), 3.0, np.float32)}
    model = by_hand([make_node("MatMul", ["x", "w"], ["y"])], weights, 1024, 32)
    quantised, constants = quantize_model(model, weights)
    x = np.full((16, 1024), 5.0, np.float32)
    found = session(quantised, {**weights, **constants}, exact).run(None, {"x": x})[0]
    np.testing.assert_allclose(found, 1024 * 15.0, rtol=1e-5)


def test_a_transposed_constant_is_found_behind_its_transposition_and_shared_by_two_products() -> None:
    rng = np.random.default_rng(0)
    weights = {"w": rng.standard_normal((8, 8)).astype(np.float32)}
    nodes = [
        make_node("Transpose", ["w"], ["wt"], perm=[1, 0]),
        make_node("MatMul", ["x", "wt"], ["h"]),
        make_node("MatMul", ["h", "wt"], ["i"]),
        make_node("MatMul", ["i", "w"], ["y"]),
    ]
    quantised, constants = quantize_model(by_hand(nodes, weights, 8, 8), weights)
    assert [node.op_type for node in quantised.graph.node] == ["DynamicQuantizeMatMul"] * 3
    assert {tensor.name for tensor in quantised.graph.initializer} == set(constants), "the float32 matrix is not read"
    assert len(constants) == 6, "onnxruntime refuses shared integers where it makes them unsigned"
    x = rng.standard_normal((5, 8)).astype(np.float32)
    found = session(quantised, constants).run(None, {"x": x})[0]
    expected = x @ weights["w"].T @ weights["w"].T @ weights["w"]
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    "nodes",
    [
        [make_node("Gemm", ["x", "w"], ["y"], alpha=0.5)],
        [make_node("Gemm", ["x", "w", "b"], ["y"], beta=2.0)],
        [make_node("Gemm", ["x", "w"], ["t"], transA=1), make_node("MatMul", ["x", "t"], ["y"])],
        [make_node("Gemm", ["x", "w", "row"], ["y"])],
        [make_node("MatMul", ["w", "x"], ["y"])],
        [make_node("Add", ["x", "x"], ["d"]), make_node("MatMul", ["x", "d"], ["y"])],
        [make_node("MatMul", ["w", "w"], ["y"])],
        [make_node("MatMul", ["x", "stack"], ["y"])],
    ],
)
def test_what_is_no_plain_product_by_a_constant_stays_as_it_is(nodes: list[NodeProto]) -> None:
    weights = {
        "w": np.ones((4, 4), np.float32),
        "b": np.ones(4, np.float32),
        "row": np.ones((1, 4), np.float32),
        "stack": np.ones((2, 4, 4), np.float32),
    }
    model = by_hand(nodes, weights, 4, 4)
    same, constants = quantize_model(model, weights)
    assert constants == {}
    assert same.SerializeToString() == model.SerializeToString()
    with pytest.raises(LoweringError, match="no piece of blocks multiplies by a constant"):
        lower_precision({"block_00": model, "stem": model}, weights, "int8")


def test_a_matrix_that_something_else_reads_stays_beside_the_integers() -> None:
    weights = {"w": np.eye(4, dtype=np.float32)}
    nodes = [make_node("MatMul", ["x", "w"], ["h"]), make_node("Gemm", ["h", "w", "w"], ["y"])]
    quantised, constants = quantize_model(by_hand(nodes, weights, 4, 4), weights)
    assert {tensor.name for tensor in quantised.graph.initializer} == {"w", *constants}


def test_only_blocks_are_lowered_and_the_notes_say_which() -> None:
    weights = {"w": np.ones((4, 4), np.float32)}
    product = by_hand([make_node("MatMul", ["x", "w"], ["y"])], weights, 4, 4)
    other = by_hand([make_node("Add", ["x", "x"], ["y"])], {}, 4, 4)
    models = {"stem": product, "block_00": product, "block_01": other, "advance": product, "condition": product}
    made, constants, notes = lower_precision(models, weights, "int8")
    assert list(made) == ["block_00"]
    assert {name: (value.dtype.name, value.shape) for name, value in constants.items()} == {
        "w.int8": ("int8", (4, 4)),
        "w.int8.scale": ("float32", (4,)),
    }
    assert notes[0].startswith("int8: 1 matrices of 1 of 2 blocks") and "block_01 stays fp32" in notes[1]
    again = lower_precision(models, weights, "int8")[0]
    assert again["block_00"].SerializeToString(deterministic=True) == made["block_00"].SerializeToString(
        deterministic=True
    )


def test_products_of_few_rows_stay_in_the_prologue_and_not_in_blocks() -> None:
    """A condition vector is one row, of numbers of many sizes, and one scale is too few for it."""
    kinds = {"many": f32(B, LEAST_ROWS, 4), "few": f32(B, LEAST_ROWS - 1, 4), "vector": f32(B, 4)}
    nodes = tuple(node(f"{name}.made", "linear.default", kind, Ref(name), Ref(name[0])) for name, kind in kinds.items())
    weights = {name[0]: np.ones((4, 4), np.float32) for name in kinds}
    graph = Graph(kinds, dict.fromkeys(weights, f32(4, 4)), nodes, tuple(each.name for each in nodes))
    models = {"condition": lower_graph(graph, "condition"), "block_00": lower_graph(graph, "block_00")}
    for part, expected in (("condition", {"m"}), ("blocks", {"m", "f", "v"})):
        _, constants, _ = lower_precision(models, weights, "int8", (part,))
        assert {name.removesuffix(".int8") for name in constants if name.endswith(".int8")} == expected


def test_a_precision_that_cannot_be_had_is_refused_with_what_can() -> None:
    for name in ("bf16", "int3"):
        with pytest.raises(LoweringError, match=f"'{name}': expected one of 'fp32', 'int8'"):
            lower_precision({}, {}, name)


def test_the_product_that_a_convolution_became_is_found_behind_its_reshape() -> None:
    """``lower.program``: ``[out, channels, kernel]`` is turned and reshaped to ``[kernel * channels, out]``."""
    rng = np.random.default_rng(0)
    sizes = {"w": (5, 4, 3), "b": (5,)}
    weights = {name: rng.standard_normal(size).astype(np.float32) for name, size in sizes.items()}
    kind, made = f32(B, 4, 7), f32(B, 5, 7)
    convolution = node("y", "conv1d.default", made, Ref("x"), Ref("w"), Ref("b"), (1,), (1,))
    graph = Graph({"x": kind}, {"w": f32(5, 4, 3), "b": f32(5)}, (convolution,), ("y",))
    quantised, constants = quantize_model(lower_graph(graph, "block_00"), weights)
    assert constants["w.int8"].shape == (12, 5)
    x = rng.standard_normal((2, 4, 7)).astype(np.float32)
    found = session(quantised, {**weights, **constants}).run(None, {"x": x})[0]
    w, b = map(torch.from_numpy, weights.values())
    expected = functional.conv1d(torch.from_numpy(x), w, b, padding=1).numpy()
    assert 0 < np.linalg.norm(found - expected) / np.linalg.norm(expected) < 0.02


def test_in_four_bits_a_product_reads_blocks_of_the_matrix() -> None:
    rng = np.random.default_rng(0)
    weights = {"w": rng.standard_normal((24, 100)).astype(np.float32), "b": rng.standard_normal(24).astype(np.float32)}
    nodes = [make_node("Gemm", ["x", "w", "b"], ["h"], transB=1), make_node("MatMul", ["h", "w"], ["y"])]
    quantised, constants = quantize_model(by_hand(nodes, weights, 100, 100), weights, precision="int4")
    assert [node.op_type for node in quantised.graph.node] == ["MatMulNBits"] * 2
    assert {name: value.shape for name, value in constants.items()} == {
        "w.int4": (24, 2, 32),
        "w.int4.scale": (24, 2),
        "w.int4_": (100, 1, 32),
        "w.int4_.scale": (100, 1),
    }
    # Numbers that eight bits hold: the largest of each block is 127, so that one step of the activations is 1.
    x = rng.integers(-127, 128, (5, 100)).astype(np.float32)
    x[:, ::64] = 127
    first = by_hand(nodes[:1], weights, 100, 24)
    first.graph.output[0].name = "h"
    quantised, constants = quantize_model(first, weights, precision="int4")
    found = session(quantised, {**weights, **constants}).run(None, {"x": x})[0]
    expected = x @ unpack(constants["w.int4"], constants["w.int4.scale"], 100) + weights["b"]
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-5 * np.abs(expected).max())


def test_four_bits_are_of_blocks_and_prefix_and_eight_of_frames() -> None:
    weights = {"w": np.ones((4, 4), np.float32)}
    kind = f32(B, 16, 4)
    product = node("y", "linear.default", kind, Ref("x"), Ref("w"))
    graph = Graph({"x": kind}, {"w": f32(4, 4)}, (product,), ("y",))
    names = {"condition": "int4", "step": "int4", "block_00": "int4", "frame_00": "int8"}
    for name, expected in names.items():
        part = "blocks" if name == "block_00" else name
        _, constants, notes = lower_precision({name: lower_graph(graph, name)}, weights, "int4", (part,))
        assert set(constants) == {f"w.{expected}", f"w.{expected}.scale"}
        assert notes[0].startswith("int4: 1 matrices")


@pytest.mark.parametrize("precision", ["int8", "int4"])
def test_rows_of_a_large_table_are_read_in_eight_bits(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    weights = {"t": (rng.standard_normal((50, 8)) * 10.0 ** rng.uniform(-2, 2, (50, 1))).astype(np.float32)}
    kinds = (("i", TensorProto.INT64, ["N"]), ("y", TensorProto.FLOAT, ["N", 8]))
    ends = [make_tensor_value_info(*kind) for kind in kinds]
    empty = [TensorProto(name="t", dims=(50, 8), data_type=TensorProto.FLOAT)]

    def model(**attributes: Any) -> ModelProto:
        graph = make_graph([make_node("Gather", ["t", "i"], ["y"], **attributes)], "g", ends[:1], ends[1:], empty)
        return make_model(graph, opset_imports=[make_opsetid("", 23)], ir_version=10)

    assert quantize_model(model(), weights, precision=precision)[1] == {}, "a small table stays as it is"
    monkeypatch.setattr(lowering, "LEAST_TABLE", 400)
    assert quantize_model(model(axis=1), weights, precision=precision)[1] == {}
    quantised, constants = quantize_model(model(), weights, precision=precision)
    assert {name: value.shape for name, value in constants.items()} == {"t.int8": (50, 8), "t.int8.scale": (50, 1)}
    rows = np.array([3, 49, 3, 0])
    found = session(quantised, constants).run(None, {"i": rows})[0]
    assert (np.abs(found - weights["t"][rows]) <= 0.501 * constants["t.int8.scale"][rows]).all()


def test_convolutions_that_stay_are_counted() -> None:
    """One over few positions, which is a product, and one over many."""
    few, many = f32(B, 4, 7), f32(B, 4, 40)
    values = {name: np.ones((4, 4, 3), np.float32) for name in ("v", "w")}
    nodes = tuple(
        node(out, "conv1d.default", kind, Ref(into), Ref(weight), None, (1,), (1,))
        for out, kind, into, weight in (("y", few, "x", "v"), ("z", many, "long", "w"))
    )
    graph = Graph({"x": few, "long": many}, dict.fromkeys(values, f32(4, 4, 3)), nodes, ("y", "z"))
    _, constants, notes = lower_precision({"block_00": lower_graph(graph, "block_00")}, values, "int8")
    assert set(constants) == {"v.int8", "v.int8.scale"}
    assert notes[1] == "convolutions that stay fp32 in blocks, of few channels, in groups, or transposed: 1"
