"""Convolutions in integers: exactly the quantised ones, and only where that is faster and can be done."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from onnx import ModelProto, NodeProto, TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info
from onnx.numpy_helper import from_array
from torch.nn import functional

from tests.lower.sessions import Array, session
from ttscompile.lower.integer_convolution import LEAST, shapes_of
from ttscompile.lower.precision import quantize_matrix, quantize_model
from ttscompile.measure.machine import has_integer_dot_product

IN, OUT = 32, 64


def model_of(nodes: list[NodeProto], shape: tuple[int | str, ...], weights: Mapping[str, Array]) -> ModelProto:
    """A model from ``x`` to ``y``, both of float32."""
    empty = [TensorProto(name=name, dims=value.shape, data_type=TensorProto.FLOAT) for name, value in weights.items()]
    ends = (make_tensor_value_info("x", TensorProto.FLOAT, shape), make_tensor_value_info("y", TensorProto.FLOAT, None))
    graph = make_graph(nodes, "g", [ends[0]], [ends[1]], empty)
    return make_model(graph, opset_imports=[make_opsetid("", 23)], ir_version=10)


def drawn(*shape: int) -> Array:
    return np.random.default_rng(sum(shape)).standard_normal(shape).astype(np.float32)


def quantised(x: Array, weight: Array) -> tuple[torch.Tensor, torch.Tensor]:
    """What their integers stand for, in float64: uint8 with one scale, int8 with one for each channel of the result."""
    low, high = min(0.0, float(x.min())), max(0.0, float(x.max()))
    scale = np.float32((np.float32(high) - np.float32(low)) / np.float32(255))
    zero = np.clip(np.rint(-low / scale), 0, 255)
    seen = (np.clip(np.rint(x / scale) + zero, 0, 255) - zero) * np.float64(scale)
    values, scales = quantize_matrix(weight.reshape(len(weight), -1).T)
    return torch.from_numpy(seen), torch.from_numpy((values * scales.astype("f8")).T.reshape(weight.shape))


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize(
    ("sizes", "kernel", "given"),
    [
        ((9, 7), (3, 3), {"pads": [1, 1, 1, 1]}),
        ((9, 8), (3, 2), {"strides": [2, 1], "pads": [0, 1, 2, 1]}),
        ((11, 12), (3, 3), {"dilations": [2, 3], "strides": [1, 2]}),
        ((8, 8), (4, 4), {"strides": [4, 4]}),
        ((6, 15), (2, 5), {"strides": [2, 5]}),
        ((9, 8), (4, 4), {"strides": [4, 4]}),
        ((8, 8), (4, 4), {"strides": [4, 4], "pads": [1, 1, 1, 1]}),
        ((4, 3), (2, 2), {"strides": [2, 2], "dilations": [2, 1]}),
        ((5, 6), (1, 1), {}),
        ((5, 6), (1, 1), {"strides": [2, 2]}),
        ((40,), (5,), {"pads": [2, 2]}),
        ((40,), (5,), {"strides": [5]}),
    ],
)
@pytest.mark.parametrize("bias", [True, False])
def test_it_is_exactly_the_quantised_convolution(
    sizes: tuple[int, ...], kernel: tuple[int, ...], given: dict[str, Any], bias: bool, exact: bool
) -> None:
    """A pixel at a wrong place, a border that is not zero, a swapped axis: all far beyond rounding of float32."""
    if not exact and not has_integer_dot_product():
        pytest.skip("this processor has no integer dot product: runtimes do not use it without the exact sums")
    weights = {"w": drawn(OUT, IN, *kernel)} | ({"b": drawn(OUT)} if bias else {})
    node = make_node("Conv", ["x", *weights], ["y"], "conv", **given)
    made, constants = quantize_model(model_of([node], ("B", IN, *sizes), weights), weights)
    assert "Conv" not in {each.op_type for each in made.graph.node}
    assert {name: value.dtype for name, value in constants.items()} == {"w.int8": np.int8, "w.int8.scale": np.float32}
    x = drawn(2, IN, *sizes) + np.float32(0.4)
    found = session(made, {**weights, **constants}, exact).run(None, {"x": x})[0]
    pads = np.array(given.get("pads", [0] * 2 * len(sizes))).reshape(2, -1)
    seen, matrix = quantised(x, weights["w"])
    around = [int(n) for axis in reversed(range(len(sizes))) for n in pads[:, axis]]
    convolve = functional.conv1d if len(sizes) == 1 else functional.conv2d
    settings = {"stride": given.get("strides", 1), "dilation": given.get("dilations", 1)}
    expected = convolve(functional.pad(seen, around), matrix, **settings).numpy()
    expected += weights.get("b", np.zeros(OUT)).reshape(-1, *[1] * len(sizes))
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-4 * np.abs(expected).max())


def test_patches_need_no_numbers_of_places() -> None:
    """Those of SmolVLA's pictures would be a megabyte in each model that has them."""
    weights = {"w": drawn(OUT, IN, 4, 4)}
    for strides, numbered in (([4, 4], False), ([2, 4], True)):
        node = make_node("Conv", ["x", "w"], ["y"], strides=strides)
        made, _ = quantize_model(model_of([node], ("B", IN, 8, 8), weights), weights)
        assert ("Gather" in {each.op_type for each in made.graph.node}) is numbered


@pytest.mark.parametrize(
    ("node", "weight", "shape"),
    [
        (make_node("Conv", ["x", "w"], ["y"], group=2), (OUT, IN, 3, 3), ("B", 2 * IN, 8, 8)),
        (make_node("Conv", ["x", "w"], ["y"]), (OUT, LEAST // OUT - 1, 3, 3), ("B", LEAST // OUT - 1, 8, 8)),
        (make_node("Conv", ["x", "w"], ["y"]), (OUT, IN, 3, 3), ("B", IN, "H", 8)),
        (make_node("Conv", ["x", "w"], ["y"], auto_pad="SAME_UPPER"), (OUT, IN, 3, 3), ("B", IN, 8, 8)),
        (make_node("Conv", ["x", "w", "x"], ["y"]), (OUT, IN, 3, 3), ("B", IN, 8, 8)),
        (make_node("ConvTranspose", ["x", "w"], ["y"]), (IN, OUT, 3, 3), ("B", IN, 8, 8)),
    ],
    ids=["groups", "few channels", "unknown size", "other padding", "a bias that is computed", "transposed"],
)
def test_what_is_slower_or_unknown_stays_as_it_is(
    node: NodeProto, weight: tuple[int, ...], shape: tuple[int | str, ...]
) -> None:
    weights = {"w": drawn(*weight)}
    model = model_of([node], shape, weights)
    same, constants = quantize_model(model, weights)
    assert constants == {}
    assert same == model


def test_a_size_that_is_divided_is_known() -> None:
    """The number of streams, of an input with two rows for each: a mask that is a constant is expanded to it."""
    nodes = [
        make_node("Shape", ["x"], ["rows"], start=0, end=1),
        make_node("Squeeze", ["rows"], ["number"]),
        make_node("Div", ["number", "two"], ["streams"]),
        make_node("Reshape", ["streams", "flat"], ["first"]),
        make_node("Concat", ["first", "tokens"], ["shape"], axis=0),
        make_node("Expand", ["mask", "shape"], ["masks"]),
        make_node("Cast", ["masks"], ["y"], to=TensorProto.FLOAT),
    ]
    kept = [("two", np.array(2)), ("flat", np.array([-1])), ("tokens", np.array([5])), ("mask", np.ones((1, 5), bool))]
    inputs, outputs = ([make_tensor_value_info(name, TensorProto.FLOAT, ["2*B", 3])] for name in "xy")
    graph = make_graph(nodes, "g", inputs, outputs, [from_array(value, name) for name, value in kept])
    model = make_model(graph, opset_imports=[make_opsetid("", 23)], ir_version=10)
    before = model.SerializeToString()
    assert shapes_of(model)["masks"] == (1, 5) and shapes_of(model, 4)["masks"] == (4, 5)
    assert model.SerializeToString() == before
